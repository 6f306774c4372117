#!/usr/bin/env python3
"""Renders images along a TUM-VI room's motion capture with `vidar synth` and puts the room's real IMU beside them.

Needs: pip install numpy
  python bench/tumvi_real_imu.py dataset-room1_512_16 OUT --seed 931

The folder has mav0/mocap0/data.csv (poses of the IMU) and mav0/imu0/data.csv (raw BMI160). `vidar synth` begins its path a little after the
first pose and smooths it; the real rows are shifted to where the real gyroscope agrees best with the simulated one, within 1 ms. What
disagreement remains (gains and axes of the real sensor, noise of the motion capture) is printed.
"""
import argparse
import subprocess
from pathlib import Path

import numpy as np


def rows(path):
    """Integer nanoseconds and the other columns of a csv."""
    lines = [line.split(",") for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    return np.array([int(line[0]) for line in lines]), np.array([[float(v) for v in line[1:]] for line in lines])


def disagreement(simulated_secs, simulated, real_secs, real, shift):
    """RMS of the gyroscopes' difference, means removed, rad/s; None unless the real rows cover the simulated ones."""
    at = simulated_secs + shift
    if at[0] < real_secs[0] or at[-1] > real_secs[-1]:
        return None
    difference = np.stack([simulated[:, k] - np.interp(at, real_secs, real[:, k]) for k in range(3)], 1)
    return float(np.sqrt(((difference - difference.mean(0)) ** 2).mean()))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("room", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", default="931")
    parser.add_argument("--size", default="480x360")
    parser.add_argument("--vidar", default="target/release/vidar")
    args = parser.parse_args()

    times, poses = rows(args.room / "mav0" / "mocap0" / "data.csv")
    flight = args.out.parent / f"{args.out.name}.tum"
    flight.parent.mkdir(parents=True, exist_ok=True)
    with open(flight, "w") as file:
        for t, (x, y, z, qw, qx, qy, qz) in zip(times, poses[:, :7]):
            file.write(f"{t // 10**9}.{t % 10**9:09d} {x:.9f} {y:.9f} {z:.9f} {qx:.9f} {qy:.9f} {qz:.9f} {qw:.9f}\n")
    subprocess.run([args.vidar, "synth", str(args.out), "--preset", "tumvi", "--seed", args.seed, "--size", args.size, "--frame-rate", "20",
                    "--duration", "20", "--trajectory", str(flight)], check=True)

    imu = args.out / "mav0" / "imu0" / "data.csv"
    simulated_ns, simulated = rows(imu)
    real_ns, real = rows(args.room / "mav0" / "imu0" / "data.csv")
    simulated_secs, real_secs = 1e-9 * (simulated_ns - simulated_ns[0]), 1e-9 * (real_ns - real_ns[0])
    best = None
    for shift in np.arange(-0.5, 1.5, 0.001):
        error = disagreement(simulated_secs, simulated, real_secs, real, shift)
        if error is not None and (best is None or error < best[0]):
            best = (error, float(shift))
    if best is None:
        raise SystemExit(f"{args.room}: the real IMU does not cover the rendered {simulated_secs[-1]:.1f} s")
    error, shift = best
    move = int(simulated_ns[0] - real_ns[0]) - round(1e9 * shift)
    with open(imu, "w") as file:
        file.write("#timestamp [ns],w_x [rad s^-1],w_y,w_z,a_x [m s^-2],a_y,a_z\n")
        for t, values in zip(real_ns + move, real):
            if simulated_ns[0] <= t <= simulated_ns[-1]:
                file.write(f"{t}," + ",".join(f"{v:.10f}" for v in values) + "\n")
    print(f"{args.out}: the real IMU begins {1e3 * shift:.0f} ms before the images; its gyroscope differs by {error:.4f} rad/s (RMS)")


if __name__ == "__main__":
    main()
