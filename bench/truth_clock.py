#!/usr/bin/env python3
"""How late the positions of a recording's ground truth are against its own IMU, without looking at any image.

Needs: pip install numpy
  python bench/truth_clock.py euroc_MH_01_real_11s
  python bench/truth_clock.py euroc_MH_01_real_11s --trajectory RUN/trajectory/final_body.tum

The accelerometer, turned into the world by the ground truth's orientation, is integrated twice and shifted in time; both it and the ground
truth's positions pass the same second derivative (a cubic fitted to a window), so constants and drifts of the integral fall out. The
shift with the smallest difference is the answer, for windows of three lengths. With --trajectory: the error after the best rigid motion of a
trajectory whose stamps are shifted alike.
"""
import argparse
from pathlib import Path

import numpy as np

SHIFTS = np.arange(-0.030, 0.0301, 0.001)
WINDOWS_SECS = (0.2, 0.4, 0.6)
GRAVITY = np.array([0.0, 0.0, -9.81])


def read(folder):
    table = lambda name: np.loadtxt(folder / "mav0" / name / "data.csv", delimiter=",", comments="#")
    truth, imu = table("state_groundtruth_estimate0"), table("imu0")
    begin = truth[0, 0]
    return (truth[:, 0] - begin) * 1e-9, truth, (imu[:, 0] - begin) * 1e-9, imu, begin * 1e-9


def rotations(wxyz):
    w, x, y, z = wxyz.T
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
            2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
            2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]
    return np.stack(rows, 1).reshape(-1, 3, 3)


def resampled(times, values, at):
    return np.stack([np.interp(at, times, column) for column in values.T], 1)


def second_derivative(values, step, window_secs):
    half = int(round(window_secs / step / 2))
    k = np.arange(-half, half + 1) * step
    kernel = np.linalg.pinv(np.stack([np.ones_like(k), k, k * k / 2, k**3 / 6], 1))[2]
    return np.stack([np.convolve(column, kernel[::-1], "valid") for column in values.T], 1)


def integrated(values, step):
    """By trapezoids: a plain sum is half a step early."""
    return np.concatenate([np.zeros((1, 3)), np.cumsum((values[1:] + values[:-1]) * (step / 2), 0)])


def lag_of_truth(times, truth, imu_times, imu, window_secs):
    """The shift, s, and the RMS difference of accelerations there and without a shift, m/s²."""
    step = np.median(np.diff(times))
    measured = resampled(imu_times, imu[:, 4:7], times) - truth[:, 14:17]
    in_world = np.einsum("nij,nj->ni", rotations(truth[:, 4:8]), measured) + GRAVITY
    integral = integrated(integrated(in_world, step), step)
    truth_acceleration = second_derivative(truth[:, 1:4], step, window_secs)
    edge = int(0.1 / step)  # beyond the ends the shifted integral is held, not known
    costs = []
    for shift in SHIFTS:
        difference = truth_acceleration - second_derivative(resampled(times, integral, times - shift), step, window_secs)
        difference = difference[edge:-edge] - difference[edge:-edge].mean(0)
        costs.append(float(np.sqrt((difference**2).sum(1).mean())))
    best = int(np.argmin(costs))
    return SHIFTS[best], costs[best], costs[len(costs) // 2]


def rigid_error(times, truth, trajectory, shift):
    at = trajectory[:, 0] + shift
    inside = (at > times[0]) & (at < times[-1])
    goal, found = resampled(times, truth[:, 1:4], at[inside]), trajectory[inside, 1:4]
    goal, found = goal - goal.mean(0), found - found.mean(0)
    u, _, v = np.linalg.svd(goal.T @ found)
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ v))]) @ v
    return float(np.sqrt(((goal - found @ turn.T) ** 2).sum(1).mean()))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--trajectory", type=Path)
    arguments = parser.parse_args()
    times, truth, imu_times, imu, begin = read(arguments.recording)
    for window in WINDOWS_SECS:
        shift, least, unshifted = lag_of_truth(times, truth, imu_times, imu, window)
        print(f"window {window:.1f} s: positions {1e3 * shift:+.0f} ms late; difference {least:.3f}, without a shift {unshifted:.3f} m/s^2")
    if arguments.trajectory:
        trajectory = np.loadtxt(arguments.trajectory, comments="#")
        trajectory[:, 0] -= begin
        for shift in (0.0, 0.004, 0.006, 0.008, 0.010, 0.012):
            print(f"ATE SE(3) with the trajectory {1e3 * shift:.0f} ms later: {rigid_error(times, truth, trajectory, shift):.4f} m")


if __name__ == "__main__":
    main()
