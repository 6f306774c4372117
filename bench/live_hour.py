#!/usr/bin/env python3
"""Memory of `vidar live` over a long time: a closed path is rendered once and replayed again and again, with stamps that go on.

    python3 bench/live_hour.py OUT --vidar target/release/vidar --minutes 60

The path is periodic, so that its end goes over into its beginning in pose, velocity and acceleration; images are links to those of one
round, the IMU's rows are repeated. The recording is replayed as fast as it goes: nothing is left out, and there are as many keyframes as
in an hour at its own rate. Standard output: minutes of film mapped, keyframes, and resident memory, MB, once a round; then the result.
Needs nothing but Python.
"""
import argparse
import json
import math
import os
import re
import shutil
import subprocess
import time
from pathlib import Path

PERIOD_SECS = 20
RATE_HZ = 200
MARGIN_SECS = 4
WORLD = """
seed = {seed}
start = "in-flight"
duration_secs = {duration}
camera_rate_hz = 20.0
width = 376
height = 240
exposure_secs = 0.004
image_noise_sigma = 2.0
depth = false
scan_spacing_m = 0.05
"""


def pose(t):
    """Position, m, and quaternion (x, y, z, w) of the IMU: an ellipse by a lively hand, looking along it and a little to the sides."""
    phase = 2 * math.pi * t / PERIOD_SECS
    x = 1.1 * math.cos(phase) + 0.1 * math.sin(8 * phase)
    y = 0.8 * math.sin(phase) + 0.1 * math.cos(9 * phase)
    z = 0.25 * math.sin(2 * phase) + 0.12 * math.sin(7 * phase)
    yaw = phase + math.pi / 2 + 0.4 * math.sin(2 * phase)
    pitch = 0.15 * math.sin(3 * phase)
    half_yaw, half_pitch = yaw / 2, pitch / 2
    return (x, y, z), (
        -math.sin(half_yaw) * math.sin(half_pitch),
        math.cos(half_yaw) * math.sin(half_pitch),
        math.sin(half_yaw) * math.cos(half_pitch),
        math.cos(half_yaw) * math.cos(half_pitch),
    )


def render(vidar, folder, seed):
    """One round with a margin on both sides."""
    duration = PERIOD_SECS + 2 * MARGIN_SECS
    path, world = folder / "path.tum", folder / "world.toml"
    with open(path, "w") as file:
        for i in range((duration + 2) * RATE_HZ):
            position, rotation = pose(i / RATE_HZ)
            print(1000 + i / RATE_HZ, *position, *rotation, file=file)
    world.write_text(WORLD.format(seed=seed, duration=float(duration)))
    command = [vidar, "synth", folder / "round", "--world-config", world, "--trajectory", path]
    subprocess.run(command, check=True, stdin=subprocess.DEVNULL)


def rows(path):
    """Rows of a csv file as (stamp, rest); its head."""
    lines = path.read_text().splitlines()
    head = [line for line in lines if line.startswith("#")]
    return head, [line.split(",", 1) for line in lines if not line.startswith("#")]


def repeat(source, target, times):
    """A recording of so many rounds."""
    period_ns = PERIOD_SECS * 10**9
    for sensor in ("cam0", "imu0"):
        (target / "mav0" / sensor).mkdir(parents=True)
        shutil.copy(source / "mav0" / sensor / "sensor.yaml", target / "mav0" / sensor)
    if (source / "mav0" / "body.yaml").exists():
        shutil.copy(source / "mav0" / "body.yaml", target / "mav0")
    images = target / "mav0" / "cam0" / "data"
    images.mkdir()
    first = int(rows(source / "mav0" / "cam0" / "data.csv")[1][0][0]) + MARGIN_SECS * 10**9
    for sensor in ("cam0", "imu0"):
        head, all_rows = rows(source / "mav0" / sensor / "data.csv")
        one_round = [(int(s), rest) for s, rest in all_rows if first <= int(s) < first + period_ns]
        with open(target / "mav0" / sensor / "data.csv", "w") as file:
            print(*head, sep="\n", file=file)
            for k in range(times):
                for stamp, rest in one_round:
                    later = stamp + k * period_ns
                    if sensor == "cam0":
                        image = source / "mav0" / "cam0" / "data" / rest.strip()
                        rest = f"{later}{image.suffix}"
                        os.link(image, images / rest)
                    print(f"{later},{rest}", file=file)


def resident_mb(pid):
    match = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    return int(match[1]) / 1024 if match else 0.0


def watch(vidar, recording, out):
    command = [vidar, "live", recording, "-o", out, "--json", "--progress", "off"]
    command += ["--set", "odometry.readout_ms=0", "--set", "output.depth_png=false", "--set", "output.images=false"]
    with open(out.with_suffix(".json"), "w") as result, open(out.with_suffix(".log"), "w") as events:
        process = subprocess.Popen(command, stdout=result, stderr=events, stdin=subprocess.DEVNULL)
    told, peak, poses = 0, 0.0, out / "trajectory" / "live.tum"
    while process.poll() is None:
        time.sleep(1)
        try:
            now = resident_mb(process.pid)
            count = poses.read_bytes().count(b"\n") if poses.exists() else 0
        except OSError:
            continue
        peak = max(peak, now)
        if count // (20 * PERIOD_SECS) > told:
            told = count // (20 * PERIOD_SECS)
            print(f"{told * PERIOD_SECS / 60:.1f} min {now:.0f} MB, peak {peak:.0f} MB", flush=True)
    print(f"exit code {process.returncode}, peak {peak:.0f} MB")
    result = json.loads((out / "manifest.json").read_text())["result"]
    print(json.dumps({key: result.get(key) for key in ("verdict", "live", "keyframes")}, indent=1))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--vidar", default="target/release/vidar")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=71)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    rounds = round(arguments.minutes * 60 / PERIOD_SECS)
    if not (arguments.out / "round").exists():
        render(arguments.vidar, arguments.out, arguments.seed)
    recording = arguments.out / f"{rounds}-rounds"
    if not recording.exists():
        repeat(arguments.out / "round", recording, rounds)
    watch(arguments.vidar, recording, arguments.out / f"live-{rounds}")


if __name__ == "__main__":
    main()
