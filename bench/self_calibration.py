#!/usr/bin/env python3
"""Renders hand-held recordings without any calibration, runs `vidar odometry`, and compares what it found with the truth.

Needs: pip install numpy
  cargo build --release -p vidar-cli
  python bench/self_calibration.py OUT --count 42               render, run, print the tables
  python bench/self_calibration.py OUT --count 42 --table       only the tables, of what has been run

Recording K has the seed FIRST + K. Motion, lens (focal length 0.65 to 1.1 image widths, distortion), mount (a phone's, or any of 24 axis
permutations with some degrees), readout (0 to 33 ms), clock (120 ms early to late), IMU timing, size and texture are drawn from the seed;
the IMU has a consumer's noise, biases and gains. Each lasts 20 s. Nothing of this is written into the recording: truth.json keeps it.
Errors: the focal length as mean of fx and fy; the rotation camera to body as an angle, and per axis against its standard deviation;
a number counts as wrong where it is more than 3 of its stated standard deviations off.
"""
import argparse
import json
import math
import statistics
import subprocess
import sys
from pathlib import Path

import numpy as np

MOTIONS = ("handheld", "handheld-lively", "handheld", "handheld-lively", "handheld")
GOALS = {"f %": 1.5, "clock ms": 3.0, "rotation deg": 1.0, "readout ms": 4.0}


def world(seed):
    """The settings of one recording, as TOML for `vidar synth --world-config`."""
    draw = np.random.default_rng(seed)
    width, height = ((480, 360), (640, 480), (480, 270))[draw.integers(3)]
    focal = width * draw.uniform(0.65, 1.1)
    k1 = draw.uniform(-0.2, 0.1)
    distortion = [k1, -k1 * draw.uniform(0.2, 1.2) * 0.5, draw.uniform(-5e-4, 5e-4), draw.uniform(-5e-4, 5e-4)]
    centre = draw.uniform(-0.01, 0.01, 2) * width
    noise = 5e-4 * draw.uniform(0.5, 2.0)
    motion = MOTIONS[seed % len(MOTIONS)]
    start = "start = { static = { secs = 2.0 } }" if draw.uniform() < 0.25 else 'start = "in-flight"'
    return f"""seed = {seed}
flight = "{motion}"
{start}
duration_secs = 20.0
camera_rate_hz = {draw.choice([20.0, 24.0])}
width = {width}
height = {height}
exposure_secs = {draw.uniform(0.004, 0.012):.4f}
exposure_drift = 0.3
image_noise_sigma = {draw.uniform(1.5, 4.0):.2f}
vignetting = 0.25
depth = false
initial_gyro_bias_rad_per_s = 0.02
initial_accel_bias_m_per_s2 = 0.15
bare_share = {draw.choice([0.0, 0.15, 0.3])}
imu_rate_hz = 200.0
imu_noise = {{ gyro_noise_density = {noise:.2e}, gyro_random_walk = 2e-5, accel_noise_density = {10 * noise:.2e}, accel_random_walk = 1e-3, rate_hz = 200.0 }}

[device]
lens = {{ radtan = {{ focal_px = {focal:.3f}, centre_offset_px = [{centre[0]:.3f}, {centre[1]:.3f}], distortion = {[float(round(v, 6)) for v in distortion]} }} }}
mount = "{draw.choice(["phone", "any-axes"])}"
readout_secs = {draw.choice([0.0, draw.uniform(0.004, 0.033)]):.5f}
stamp_delay_secs = {draw.uniform(-0.12, 0.12):.5f}
frame_jitter = 0.02
dropped_frames = 0.01
jpeg_quality = {draw.choice([75, 90])}
imu_timing = "{draw.choice(["regular", "jittered", "interleaved"])}"
imu_scale_sigma = 0.005
calibration = "absent"
"""


def run(out, name, seed, vidar):
    folder, result = out / name, out / f"{name}.json"
    if not (folder / "truth.json").exists():
        config = out / f"{name}.toml"
        config.write_text(world(seed))
        subprocess.run([vidar, "synth", folder, "--world-config", config, "--quiet"], check=True)
    if not result.exists():
        done = subprocess.run([vidar, "odometry", folder, "--json", "-o", out / f"{name}-run"], capture_output=True, text=True)
        result.write_text(done.stdout or json.dumps({"error": done.stderr}))


def rotation_of(xyzw):
    x, y, z, w = np.asarray(xyzw) / np.linalg.norm(xyzw)
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def rotation_vector(rotation):
    angle = math.acos(max(-1.0, min(1.0, (np.trace(rotation) - 1) / 2)))
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return axis / 2 if angle < 1e-9 else axis * angle / (2 * math.sin(angle))


def errors(result, truth):
    """Of each quantity: the error, and the error in units of its stated standard deviation."""
    found, device = result["final"]["calibration"], truth["camera"]
    focal = np.mean(found["intrinsics"][:2]) / np.mean(device["intrinsics"][:2]) - 1
    focal_std = found["intrinsics_std"][0] / found["intrinsics"][0]
    clock = found["time_offset_ms"] - 1e3 * device["imu_time_minus_stamp_secs"]
    readout = found["readout_ms"] - 1e3 * device["readout_secs"]
    true_rotation = np.array(device["body_from_camera"]).reshape(4, 4)[:3, :3]
    # Right perturbation, in the camera's axes, as `rotation_std_rad` states it.
    turn = rotation_vector(true_rotation.T @ rotation_of(found["body_from_camera_xyzw"]))
    return {
        "f %": (100 * focal, focal / focal_std if focal_std > 0 else float("inf")),
        "clock ms": (clock, clock / found["time_offset_std_ms"]),
        "rotation deg": (math.degrees(np.linalg.norm(turn)), float(np.max(np.abs(turn) / found["rotation_std_rad"]))),
        "readout ms": (readout, readout / found["readout_std_ms"]),
    }


def table(out):
    rows, refused, trajectories, wrong_recordings = [], [], [], 0
    for path in sorted(out.glob("*.json")):
        result = json.loads(path.read_text())
        name = path.stem
        if not result.get("final"):
            error = result.get("error") or result.get("verdict") or result
            refused.append((name, error.get("message", error) if isinstance(error, dict) else str(error).strip().splitlines()[0]))
            continue
        truth = json.loads((out / name / "truth.json").read_text())
        found = errors(result, truth)
        rows.append(found)
        wrong_recordings += any(abs(score) > 3 for _, score in found.values())
        trajectory = result["final"]["trajectory"]
        log_scale = math.log(trajectory["scale"])
        trajectories.append((100 * trajectory["ate_se3_m"]["rmse"] / trajectory["truth_path_m"], abs(log_scale),
                             abs(log_scale) / result["scale"]["sigma"], result["final"]["images"] / result["images"]))
        print(f"{name:14s} " + "  ".join(f"{key} {value:+.3f} ({score:+.1f} sigma)" for key, (value, score) in found.items())
              + f"  ATE {trajectories[-1][0]:.2f} % of path, ln s {log_scale:+.4f} ({trajectories[-1][2]:.1f} sigma)")
    for name, reason in refused:
        print(f"{name:14s} refused: {str(reason)[:200]}")
    if not rows:
        sys.exit("nothing has been run")
    print(f"\n{len(rows)} calibrated, {len(refused)} refused; recordings with a number beyond 3 sigma: {wrong_recordings}")
    print("| | goal | median error | largest | error / sigma, RMS | beyond 3 sigma |\n|---|--:|--:|--:|--:|--:|")
    for key, goal in GOALS.items():
        value = [abs(row[key][0]) for row in rows]
        score = [abs(row[key][1]) for row in rows]
        print(f"| {key} | {goal} | {statistics.median(value):.3f} | {max(value):.3f} "
              f"| {math.sqrt(statistics.mean(s * s for s in score)):.2f} | {sum(s > 3 for s in score)} of {len(rows)} |")
    share, scale, score, images = zip(*trajectories)
    print(f"\nATE median {statistics.median(share):.2f} % of the path (largest {max(share):.2f}); |ln s| median {statistics.median(scale):.4f}, "
          f"within 2 sigma {sum(s <= 2 for s in score)}, 3 sigma {sum(s <= 3 for s in score)} of {len(score)}; "
          f"images with a pose, least {100 * min(images):.1f} %")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=42)
    parser.add_argument("--first", type=int, default=3000, help="seed of the first recording")
    parser.add_argument("--vidar", default="target/release/vidar")
    parser.add_argument("--table", action="store_true", help="run nothing")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    if not arguments.table:
        for index in range(arguments.count):
            run(arguments.out, f"seed-{arguments.first + index}", arguments.first + index, arguments.vidar)
    table(arguments.out)


if __name__ == "__main__":
    main()
