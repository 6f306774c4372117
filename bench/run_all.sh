#!/usr/bin/env bash
# Measures every headline figure of BENCHMARK.md anew, all from the commit that is checked out.
#
#   bench/run_all.sh --list                  print the commands of every group and run nothing
#   bench/run_all.sh                         run all groups (hours on two cores)
#   bench/run_all.sh maps odometry           run some groups
#
# Groups: demo maps couplings odometry ordinary stereo align fusion evaluation peers da3 nano; and tables, the paper's tables on rendered
# flights, only when named
#
# Environment:
#   DATA    folder with the real recordings euroc_MH_01_real_11s, hololens_commonroom, 7scenes_redkitchen
#           (default ../shared/data)
#   EUROC   folder with mav0/ per EuRoC sequence; ground truth suffices (default $DATA/euroc)
#   TUMVI   folder with dataset-room1_512_16 and rooms 2, 4, 6; IMU and motion capture suffice (default $DATA/tumvi)
#   OUT     folder of the results (default runs/bench-<commit>)
#   FLIGHTS, ORDINARY   folders of rendered flights and of rendered hand-held recordings (default in OUT); what is there is not
#           rendered again
#   PYTHON  interpreter with the packages of bench/requirements-da3.txt, numpy, scipy, numba, open3d-cpu==0.19.0, pillow,
#           opencv-python-headless, pycolmap
#
# Each step writes its output, its command, its wall time and its processor time to $OUT/<step>.txt, and is left out where that file says
# that it was done: the script goes on where it was stopped. A step that fails is reported at the end and does not stop the others. A dirty work tree is refused, because its figures would belong to no commit.
set -uo pipefail
cd "$(dirname "$0")/.."

DATA=${DATA:-../shared/data}
EUROC=${EUROC:-$DATA/euroc}
TUMVI=${TUMVI:-$DATA/tumvi}
PYTHON=${PYTHON:-python3}
COMMIT=$(git rev-parse --short HEAD)
OUT=${OUT:-runs/bench-$COMMIT}
FLIGHTS=${FLIGHTS:-$OUT/flights}
ORDINARY=${ORDINARY:-$OUT/ordinary}
VIDAR=target/release/vidar
EXAMPLES=target/release/examples

list=false
groups=()
for argument in "$@"; do
    case $argument in
        --list) list=true ;;
        demo|maps|stereo|odometry|ordinary|couplings|tables|align|fusion|evaluation|peers|da3|nano) groups+=("$argument") ;;
        *) echo "unknown argument $argument; see the head of bench/run_all.sh" >&2; exit 2 ;;
    esac
done
[ ${#groups[@]} -gt 0 ] || groups=(demo maps couplings odometry ordinary stereo align fusion evaluation peers da3 nano)

if ! $list && [ -n "$(git status --porcelain --untracked-files=no)" ]; then
    echo "the work tree has changes; commit them first" >&2
    exit 2
fi

failed=()

# step NAME COMMAND...: runs the command, or prints it.
step() {
    local name=$1
    shift
    if $list; then
        printf '%-24s %s\n' "$name" "$*"
        return
    fi
    mkdir -p "$OUT"
    if [ "$(tail -n 1 "$OUT/$name.txt" 2>/dev/null)" = "# done" ]; then
        return
    fi
    echo "$name …"
    local TIMEFORMAT='# %R s of wall time, %U + %S s of processor time'
    {
        echo "# commit $COMMIT"
        echo "# $*"
        time "$@"
    } > "$OUT/$name.txt" 2>&1 || { failed+=("$name"); return; }
    echo "# done" >> "$OUT/$name.txt"
}

# world FILE LINE...: a description of a synthetic world for --world-config.
world() {
    $list && return
    mkdir -p "$OUT"
    printf '%s\n' "${@:2}" > "$OUT/$1"
}

redkitchen=("$DATA/7scenes_redkitchen" --camera-model pinhole:525.1,525.1,322.3,223.3
    --depth-intrinsics 585,585,320,240)
color_from_depth=-0.023,0.012,0

demo() {
    for geometry in da3-nano stereo auto; do
        step "demo-$geometry" "$VIDAR" demo --geometry "$geometry" -o "$OUT/runs/demo-$geometry"
    done
}

maps() {
    local geometry
    for geometry in stereo auto; do
        step "map-demo-truth-$geometry" "$VIDAR" demo --geometry "$geometry" --set input.poses=ground-truth \
            -o "$OUT/runs/demo-truth-$geometry"
    done
    for geometry in stereo auto da3-nano; do
        step "map-hololens-$geometry" "$VIDAR" run "$DATA/hololens_commonroom" --geometry "$geometry" \
            -o "$OUT/runs/hololens-$geometry"
        step "map-redkitchen-$geometry" "$VIDAR" run "${redkitchen[@]}" --color-from-depth=$color_from_depth \
            --preset tum-rgbd --geometry "$geometry" -o "$OUT/runs/redkitchen-$geometry"
    done
    # A rolling shutter of 28 ms.
    local phone seed=1000
    for phone in fast slow; do
        seed=$((seed + 1))
        step "synth-phone-$phone" "$VIDAR" synth "$OUT/phone-$phone" --preset "phone-$phone" --seed $seed --size 640x480 \
            --frame-rate 20 --duration 12 --readout-ms 28 --stamp-delay-ms=20
        step "map-phone-$phone" "$VIDAR" run "$OUT/phone-$phone" --geometry auto -o "$OUT/runs/phone-$phone"
    done
    step map-mh01 "$VIDAR" run "$DATA/euroc_MH_01_real_11s" --preset euroc --set input.poses=ground-truth \
        -o "$OUT/runs/mh01"
}

stereo() {
    local example=$EXAMPLES/$STEREO_EXAMPLE
    step build-stereo cargo build --release -p vidar-stereo --example "$STEREO_EXAMPLE"
    step stereo-redkitchen "$example" "${redkitchen[@]}" --color-from-depth $color_from_depth \
        --min-translation-m 0.04 --min-rotation-deg 6
    step stereo-hololens "$example" "$DATA/hololens_commonroom" --first 26
    world hallT.toml 'seed = 21' 'scene = "hall"' 'duration_secs = 5.0'
    world roomT.toml 'seed = 22' 'duration_secs = 5.0' 'flight = "aggressive"' 'exposure_drift = 0.25' \
        'image_noise_sigma = 3.0'
    world roomU.toml 'seed = 23' 'duration_secs = 4.0' 'width = 564' 'height = 360' 'flight = "orbit"' \
        'exposure_secs = 0.008'
    for name in hallT roomT roomU; do
        step "synth-$name" "$VIDAR" synth "$OUT/$name" --world-config "$OUT/$name.toml"
    done
    step stereo-hallT "$example" "$OUT/hallT" --last 8
    step stereo-hallT-perturbed "$example" "$OUT/hallT" --first 8 --last 16 --seed 78 --jitter-deg 0.08 \
        --jitter-m 0.008 --lag-ms -5 --focal-ratio 0.995 --center-px -3
    step stereo-roomU "$example" "$OUT/roomU" --last 8
    step stereo-roomT-perturbed "$example" "$OUT/roomT" --first 8 --last 16 --seed 77 --jitter-deg 0.15 \
        --jitter-m 0.01 --lag-ms 8 --focal-ratio 1.006 --center-px 4
}

odometry() {
    step build-odometry cargo build --release -p vidar-odometry --example evaluate
    local common=('camera_rate_hz = 20.0' 'width = 752' 'height = 480' 'exposure_secs = 0.004' 'blur_samples = 2'
        'exposure_drift = 0.15' 'image_noise_sigma = 2.0' 'initial_gyro_bias_rad_per_s = 0.05'
        'initial_accel_bias_m_per_s2 = 0.1' 'depth = false' 'start = "in-flight"')
    world flight40.toml 'duration_secs = 40.0' "${common[@]}"
    world flight24.toml 'duration_secs = 24.0' "${common[@]}"
    local flights=() name length
    for name in V1_01_easy V1_02_medium V1_03_difficult V2_01_easy V2_02_medium V2_03_difficult \
        MH_01_easy MH_02_easy MH_03_medium MH_04_difficult MH_05_difficult; do
        length=24
        case $name in V1_01*|V1_03*|V2_03*|MH_03*) length=40 ;; esac
        [ -e "$FLIGHTS/$name" ] || step "synth-$name" "$VIDAR" synth "$FLIGHTS/$name" \
            --world-config "$OUT/flight$length.toml" --trajectory "$EUROC/$name/mav0/state_groundtruth_estimate0/data.csv"
        flights+=("$FLIGHTS/$name")
    done
    step odometry-real "$EXAMPLES/evaluate" --adjust "$DATA/euroc_MH_01_real_11s"
    step odometry-rendered "$EXAMPLES/evaluate" --adjust "${flights[@]}"
    step odometry-noise "$EXAMPLES/evaluate" --image-noise 3.46 --imu-noise 2 "${flights[@]}"
    step odometry-mono "$EXAMPLES/evaluate" --mono "${flights[@]:0:6}"
    local rooms=() room
    for room in 1 2 4 6; do
        [ -e "$ORDINARY-tumvi/room$room" ] || step "synth-room$room" "$PYTHON" bench/tumvi_real_imu.py \
            "$TUMVI/dataset-room${room}_512_16" "$ORDINARY-tumvi/room$room" --seed "93$room" --begin 5 --vidar "$VIDAR"
        rooms+=("$ORDINARY-tumvi/room$room")
    done
    step odometry-tumvi "$EXAMPLES/evaluate" --adjust "${rooms[@]}"
    step odometry-time "$EXAMPLES/evaluate" --repeat 3 --stages "$DATA/euroc_MH_01_real_11s" "${flights[3]}"
    step odometry-starts cargo test --release -p vidar-odometry --test flights starts -- --ignored --nocapture
    step odometry-ladder cargo test --release -p vidar-odometry --test flights ladder -- --include-ignored --nocapture
    step odometry-consistency cargo test --release -p vidar-odometry --test flights monte_carlo -- --ignored --nocapture
}

ordinary() {
    step ordinary-render env VIDAR="$VIDAR" bench/ordinary_recordings.sh "$ORDINARY"
    step ordinary bash -c '"$0" bench/odometry_vs_peers.py "$1"/* --out "$2" --vidar "$3"' \
        "$PYTHON" "$ORDINARY" "$OUT/ordinary-results" "$VIDAR"
    step ordinary-tables bash -c '"$0" bench/odometry_vs_peers.py "$1"/* --out "$2" --table' \
        "$PYTHON" "$ORDINARY" "$OUT/ordinary-results"
}

# One recording each of six flights for three seeds; every coupling with and without each measurement, nothing else changed.
couplings() {
    flights_world
    local geometry
    for geometry in simulated da3-nano; do
        step "ablation-$geometry" "$VIDAR" bench euroc "$EUROC" --synthetic --ablation --seeds 3 --world-config "$OUT/flights.toml" \
            --sequences V1,V2 --geometry "$geometry" --set keyframes.max_count=80 --set fusion.voxel_size_m=0.05 \
            --set geometry.max_width_px=280 --set eval.surface.voxel_size_m=0.05 -o "$OUT/ablation-$geometry"
    done
}

flights_world() {
    world flights.toml 'duration_secs = 40.0' 'camera_rate_hz = 20.0' 'width = 376' 'height = 240' \
        'exposure_secs = 0.004' 'blur_samples = 2' 'exposure_drift = 0.15' 'image_noise_sigma = 2.0' \
        'initial_gyro_bias_rad_per_s = 0.05' 'initial_accel_bias_m_per_s2 = 0.1' 'depth = false' \
        'scan_spacing_m = 0.02' 'start = "in-flight"'
}

tables() {
    flights_world
    local common=(bench euroc "$EUROC" --synthetic --world-config "$OUT/flights.toml" --sequences V1,V2
        --set keyframes.max_count=80 --set fusion.voxel_size_m=0.05 --set geometry.max_width_px=280
        --set eval.surface.voxel_size_m=0.05)
    step bench-simulated "$VIDAR" "${common[@]}" --geometry simulated -o "$OUT/tables-simulated"
    step bench-stereo "$VIDAR" "${common[@]}" --geometry stereo --modes pose-conditioned,ground-truth,coupled \
        -o "$OUT/tables-stereo"
    step bench-nano "$VIDAR" "${common[@]}" --model da3-nano -o "$OUT/tables-nano"
}

align() {
    step build-align cargo build --release -p vidar-align --examples
    step align-overlap "$PYTHON" bench/align_vs_reference.py --binary "$EXAMPLES/align_overlap"
    step align-graph "$PYTHON" bench/graph_vs_reference.py --binary "$EXAMPLES/solve_graphs"
    step align-regimes cargo test --release -p vidar-align --test alignment aligner_regimes -- --nocapture
}

fusion() {
    step build-fusion cargo build --release -p vidar-fusion --examples
    step fusion-open3d "$PYTHON" bench/fusion_vs_open3d.py "$DATA/7scenes_redkitchen/seq-01" \
        --binary "$EXAMPLES/fuse_folder" --rounds 3
    step fusion-loop "$EXAMPLES/loop_ghosts"
}

evaluation() {
    step build-evaluation cargo build --release -p vidar-eval --example nearest_files
    step build-hard-maps cargo build --release -p vidar-eval --example hard_maps
    local map
    for map in good moved rotated scaled outliers bent; do
        step "hard-map-$map" "$EXAMPLES/hard_maps" "$map"
    done
    step nearest "$PYTHON" bench/nn_vs_scipy.py --binary "$EXAMPLES/nearest_files" --rounds 3 1
}

# After maps and stereo, whose runs and rendered room it takes.
peers() {
    local script=(bench/maps_vs_peers.py --vidar "$VIDAR")
    step map-roomU-auto "$VIDAR" run "$OUT/roomU" --geometry auto --set input.poses=ground-truth -o "$OUT/runs/roomU-auto"
    step peers-hololens "$PYTHON" "${script[@]}" "$OUT/runs/hololens-auto" --reference "hololens:$DATA/hololens_commonroom"
    step peers-redkitchen "$PYTHON" "${script[@]}" "$OUT/runs/redkitchen-auto" \
        --reference "7scenes:$DATA/7scenes_redkitchen/seq-01" --median-depth 1.8
    step peers-roomU "$PYTHON" "${script[@]}" "$OUT/runs/roomU-auto" \
        --reference "cloud:$OUT/roomU/mav0/pointcloud0/data.ply"
}

da3() {
    step build-da3 cargo build --release -p vidar-da3 --example time_da3
    step da3-speed "$PYTHON" bench/da3_vs_torch.py --ours "$EXAMPLES/time_da3" --models da3-small da3-base \
        --views 1 4 8 16 --out "$OUT/da3.json"
    step da3-parity cargo test --release -p vidar-da3 --test network official_goldens -- --ignored --nocapture
}

nano() {
    step build-nano cargo build --release -p vidar-synth --example stream_views
    step nano-errors env PYTHONPATH=training "$PYTHON" -m nano.evaluate --model models/da3-nano \
        --stream "$EXAMPLES/stream_views" --rooms 24 --real "$DATA"
    step nano-errors-96 env PYTHONPATH=training "$PYTHON" -m nano.evaluate --model models/da3-nano \
        --stream "$EXAMPLES/stream_views" --rooms 96
}

# The example that compares stereo's confidence with the truth.
STEREO_EXAMPLE=evaluate_views

step build cargo build --release -p vidar-cli
for group in "${groups[@]}"; do
    "$group"
done
if [ ${#failed[@]} -gt 0 ]; then
    echo "failed: ${failed[*]}" >&2
    exit 1
fi
