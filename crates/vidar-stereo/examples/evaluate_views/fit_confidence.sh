#!/usr/bin/env bash
# Makes the samples that the weights in confidence.rs are fitted to, with the code as it is, and fits them.
#
#   fit_confidence.sh DATA OUT
#
# DATA holds hololens_commonroom and 7scenes_redkitchen; worlds and samples go to OUT. `vidar` and `evaluate_views` are those on the PATH,
# PYTHON an interpreter with numpy and scipy. Every set of the fit has the same weight. The sets of the test take no part.
set -euo pipefail
data=$1 out=$2
mkdir -p "$out"

world() { # NAME LINE...
    local name=$1
    shift
    [ -d "$out/$name" ] && return
    printf '%s\n' "$@" >"$out/$name.toml"
    vidar synth "$out/$name" --world-config "$out/$name.toml" >"$out/$name.log" 2>&1
}
sample() { # NAME RECORDING ARGUMENT...
    evaluate_views "${@:2}" --csv "$out/$1.csv" >"$out/$1.txt"
}
perturbed() { # NAME WORLD SEED JITTER_DEG JITTER_M LAG_MS FOCAL_RATIO CENTER_PX
    sample "$1" "$out/$2" --first 8 --last 16 --seed "$3" --jitter-deg "$4" --jitter-m "$5" --lag-ms "$6" \
        --focal-ratio "$7" --center-px "$8"
}

world roomA 'seed = 11' 'duration_secs = 5.0'
world roomB 'seed = 12' 'duration_secs = 5.0' 'flight = "orbit"' 'exposure_drift = 0.3' 'image_noise_sigma = 4.0' 'clutter = 70'
world corrA 'seed = 13' 'duration_secs = 5.0' 'scene = "corridor"' 'flight = "orbit"'
world roomC 'seed = 14' 'duration_secs = 4.0' 'width = 564' 'height = 360' 'image_noise_sigma = 2.5' 'exposure_secs = 0.008' \
    'exposure_drift = 0.2'
world hallT 'seed = 21' 'duration_secs = 5.0' 'scene = "hall"'
world roomU 'seed = 23' 'duration_secs = 4.0' 'width = 564' 'height = 360' 'flight = "orbit"' 'exposure_secs = 0.008'

sample hololensA "$data/hololens_commonroom" --last 20
for name in roomA roomB corrA roomC; do sample "$name" "$out/$name" --last 8; done
perturbed roomA1 roomA 1 0.2 0.006 0 1 0
perturbed roomB2 roomB 2 0.1 0.012 0 1.008 0
perturbed roomC3 roomC 3 0.05 0.004 15 1 0
perturbed roomC4 roomC 4 0.3 0.015 10 0.99 -4
perturbed roomB5 roomB 5 0 0 0 1 7
perturbed roomA6 roomA 6 0.1 0.008 -20 1.01 3

sample hololensB "$data/hololens_commonroom" --first 26
sample redkitchen "$data/7scenes_redkitchen" --camera-model pinhole:525.1,525.1,322.3,223.3 \
    --depth-intrinsics 585,585,320,240 --color-from-depth -0.023,0.012,0 --min-translation-m 0.04 --min-rotation-deg 6
sample roomU "$out/roomU" --last 8
sample hallT "$out/hallT" --last 8

sets=()
for name in hololensA roomA roomB corrA roomC roomA1 roomB2 roomC3 roomC4 roomB5 roomA6; do
    sets+=("fit:1:$out/$name.csv")
done
for name in hololensB redkitchen roomU hallT; do sets+=("test:1:$out/$name.csv"); done
"${PYTHON:-python3}" "$(dirname "$0")/fit_confidence.py" "${sets[@]}"
