#!/usr/bin/env bash
# Renders ordinary hand-held recordings of 20 s with `vidar synth`: for bench/odometry_vs_peers.py.
#
#   bench/ordinary_recordings.sh --list              print the commands and render nothing
#   bench/ordinary_recordings.sh OUT                 all 24: 12 with their calibration given, 12 without any
#   bench/ordinary_recordings.sh OUT given           those whose lens, camera place and IMU noise are given
#   bench/ordinary_recordings.sh OUT absent          those without any calibration
#   bench/ordinary_recordings.sh OUT NAME...         some, such as phone-slow-902
#
# Clock offset and readout are written for none of them; truth.json has the true values. A folder that is there already is
# left as it is, so a run that was broken off can be continued.
#
# Environment: VIDAR, the program (default target/release/vidar)
set -uo pipefail
cd "$(dirname "$0")/.."
VIDAR=${VIDAR:-target/release/vidar}

# preset seed size readout_ms delay_ms calibration. No setting of the odometry was chosen on these seeds.
recordings() {
    cat <<'END'
phone-slow 900 480x360 30 25 given
phone-fast 910 480x360 22 -35 given
realsense 920 480x360 24 44 given
phone-slow 901 640x480 20 -40 given
phone-fast 911 480x360 30 60 given
realsense 921 480x360 0 -60 given
phone-slow 902 480x360 10 80 given
phone-fast 912 640x480 15 -80 given
realsense 922 640x480 30 -20 given
phone-slow 903 480x360 0 -10 given
realsense 923 480x360 12 70 given
phone-fast 913 1280x720 8 10 given
phone-slow 904 480x360 26 -70 absent
phone-fast 914 480x360 28 35 absent
realsense 924 480x360 20 -44 absent
phone-slow 905 640x480 16 50 absent
phone-fast 915 640x480 5 -55 absent
realsense 925 640x480 28 30 absent
phone-slow 906 480x360 4 -25 absent
phone-fast 916 480x360 18 75 absent
realsense 926 480x360 8 -75 absent
phone-fast 917 480x360 0 0 absent
realsense 927 480x360 14 60 absent
phone-slow 907 1280x720 30 15 absent
END
}

list=false
if [ "${1:-}" = --list ]; then
    list=true
    shift
    set -- "${1:-OUT}" "${@:2}"
fi
if [ $# -eq 0 ]; then
    echo "no folder for the recordings; see the head of bench/ordinary_recordings.sh" >&2
    exit 2
fi
out=$1
shift

# wanted NAME CALIBRATION CHOICE...: whether the recording is asked for.
wanted() {
    local name=$1 calibration=$2
    shift 2
    [ $# -gt 0 ] || return 0
    local choice
    for choice in "$@"; do
        [ "$choice" = "$name" ] || [ "$choice" = "$calibration" ] && return 0
    done
    return 1
}

failed=()
matched=0
while read -r preset seed size readout delay calibration; do
    name=$preset-$seed
    wanted "$name" "$calibration" "$@" || continue
    matched=$((matched + 1))
    command=("$VIDAR" synth "$out/$name" --preset "$preset" --seed "$seed" --size "$size" --frame-rate 20 --duration 20
        --readout-ms "$readout" "--stamp-delay-ms=$delay" --calibration "$calibration")
    if $list; then
        echo "${command[*]}"
        continue
    fi
    mkdir -p "$out"
    if [ -e "$out/$name/mav0" ]; then
        echo "$name: there already"
        continue
    fi
    "${command[@]}" < /dev/null || failed+=("$name")
done < <(recordings)

if [ $matched -eq 0 ]; then
    echo "no recording is called $*" >&2
    exit 2
fi
if [ ${#failed[@]} -gt 0 ]; then
    echo "failed: ${failed[*]}" >&2
    exit 1
fi
