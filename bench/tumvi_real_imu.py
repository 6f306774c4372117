#!/usr/bin/env python3
"""Renders images along a TUM-VI room's path with `vidar synth` and puts the room's real IMU beside them.

Needs: pip install numpy scipy
  python bench/tumvi_real_imu.py dataset-room1_512_16 OUT --seed 931

The folder has mav0/mocap0/data.csv (poses of the IMU) and mav0/imu0/data.csv (raw BMI160). The motion capture alone contradicts the real
IMU by milliradians, which would be drawn into the images. So the path that is drawn is the motion capture where motion is slow, and the
IMU's own integral (with gains and biases fitted to the motion capture) where it is fast; see `fused_path`. The IMU's rows stay raw: its
gains, axes, biases and slow errors are the real ones. Its white noise above about 1 Hz is drawn into the path, and so is not seen as noise.
"""
import argparse
import subprocess
from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation, RotationSpline

RATE_HZ = 200.0
MARGIN_SECS = 4.0
# Windows of the local cubic that separates slow from fast, s. The motion capture's angular noise is 0.016 rad/s after smoothing over
# 0.25 s and 0.006 over 1 s, the gyroscope's drift over 6 s below 1 mrad; of positions the motion capture knows a millimetre.
ROTATION_SECS = 6.0
POSITION_SECS = 1.5
# Smoothing of both sides before gains and biases are fitted, s: less lets the motion capture's noise lower the gains.
FIT_SECS = 1.0


# `vidar synth`'s preset tumvi without its smoothing, which is for raw motion capture: the fused path is smooth already.
WORLD = """
seed = {seed}
start = "in-flight"
duration_secs = {duration}
camera_rate_hz = 20.0
width = 640
height = 480
exposure_secs = 0.006
exposure_drift = 0.3
image_noise_sigma = 3.0
vignetting = 0.25
depth = false
scan_spacing_m = 0.05
trajectory_smoothing_secs = 0.004
imu_noise = {{ gyro_noise_density = 1.6e-4, gyro_random_walk = 2.2e-6, accel_noise_density = 2.8e-3, accel_random_walk = 8.6e-5, rate_hz = 200.0 }}

[device]
lens = {{ radtan = {{ focal_px = 380.0, centre_offset_px = [1.0, -1.0], distortion = [-0.12, 0.05, 0.0, 0.0] }} }}
mount = "tum-vi"
frame_jitter = 0.01
jpeg_quality = 80
"""


def rows(path):
    """Integer nanoseconds and the other columns of a csv."""
    lines = [line.split(",") for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    return np.array([int(line[0]) for line in lines]), np.array([[float(v) for v in line[1:]] for line in lines])


def slow(values, secs, derivative=0):
    """The slow part of rows at RATE_HZ, or its derivative per second."""
    window = int(secs * RATE_HZ) | 1
    return savgol_filter(values, window, 3, deriv=derivative, delta=1.0 / RATE_HZ, axis=0)


def affine(source, target, residual):
    """M and b of target = M source + b by least squares; M is within about 1 % of the identity, as data sheets say.

    residual: standard deviation of what the two differ by; rows closer than FIT_SECS share their errors.
    """
    independent = FIT_SECS * RATE_HZ
    design = np.hstack([source, np.ones((len(source), 1))]) / (residual * np.sqrt(independent))
    difference = (target - source) / (residual * np.sqrt(independent))
    prior = np.diag([1e4, 1e4, 1e4, 1e-6])
    solution = np.linalg.solve(design.T @ design + prior, design.T @ difference)
    return np.eye(3) + solution[:3].T, solution[3]


def clock_offset(mocap_secs, poses, imu_secs, gyro):
    """Seconds to add to the motion capture's stamps to get the IMU's clock, by the length of the angular rate."""
    grid = np.arange(mocap_secs[0] + 1.0, mocap_secs[-1] - 1.0, 1.0 / RATE_HZ)
    spline = RotationSpline(mocap_secs, Rotation.from_quat(poses[:, [4, 5, 6, 3]]))
    captured = np.linalg.norm(slow(spline(grid, 1), FIT_SECS), axis=1)

    def residual(offset):
        sensed = np.stack([np.interp(grid + offset, imu_secs, gyro[:, k]) for k in range(3)], 1)
        return float(((np.linalg.norm(slow(sensed, FIT_SECS), axis=1) - captured) ** 2).mean())

    return min(np.arange(-0.02, 0.02, 0.00025), key=residual)


def fused_path(mocap_secs, poses, imu_secs, gyro, accel):
    """Positions (N,3) and rotations world_from_imu at the IMU's grid of RATE_HZ, and what the sensors' fit left."""
    mocap_secs = mocap_secs + clock_offset(mocap_secs, poses, imu_secs, gyro)
    grid = np.arange(max(mocap_secs[0], imu_secs[0]), min(mocap_secs[-1], imu_secs[-1]), 1.0 / RATE_HZ)
    gyro = np.stack([np.interp(grid, imu_secs, gyro[:, k]) for k in range(3)], 1)
    accel = np.stack([np.interp(grid, imu_secs, accel[:, k]) for k in range(3)], 1)
    position = CubicSpline(mocap_secs, poses[:, :3])(grid)
    rotation = RotationSpline(mocap_secs, Rotation.from_quat(poses[:, [4, 5, 6, 3]]))(grid)

    # Gains and biases of the real sensors, from what both sides say of slow motion.
    steps = (rotation[:-1].inv() * rotation[1:]).as_rotvec() * RATE_HZ
    rate = np.vstack([steps[:1], 0.5 * (steps[:-1] + steps[1:]), steps[-1:]])
    gyro_gain, gyro_bias = affine(slow(gyro, FIT_SECS), slow(rate, FIT_SECS), 0.006)
    # What of it is a rotation is the motion capture's frame against the sensor's: the path is that of the sensor.
    left, stretch, right = np.linalg.svd(gyro_gain)
    capture_from_sensor = left @ right
    gyro_gain, gyro_bias = capture_from_sensor.T @ gyro_gain, capture_from_sensor.T @ gyro_bias
    rotation = rotation * Rotation.from_matrix(capture_from_sensor)
    world_accel = slow(position, FIT_SECS, derivative=2)
    gravity = np.array([0.0, 0.0, 9.8082])
    force = rotation.inv().apply(world_accel + gravity)
    accel_gain, accel_bias = affine(slow(accel, FIT_SECS), slow(force, FIT_SECS), 0.3)

    # Fast rotation by the gyroscope, slow by the motion capture.
    rates = gyro @ gyro_gain.T + gyro_bias
    turns = Rotation.from_rotvec((rates[:-1] + rates[1:]) / (2.0 * RATE_HZ))
    integrated = [rotation[0]]
    for turn in turns:
        integrated.append(integrated[-1] * turn)
    integrated = Rotation.concatenate(integrated)
    drift = np.unwrap((rotation * integrated.inv()).as_rotvec(), axis=0)
    fused_rotation = Rotation.from_rotvec(slow(drift, ROTATION_SECS)) * integrated

    # The same for position.
    fast = fused_rotation.apply(accel @ accel_gain.T + accel_bias) - gravity
    velocity = cumulative_trapezoid(fast, dx=1.0 / RATE_HZ, axis=0, initial=0)
    walked = cumulative_trapezoid(velocity, dx=1.0 / RATE_HZ, axis=0, initial=0)
    line = straight_line(position - walked)
    fused_position = walked + slow(position - walked - line, POSITION_SECS) + line
    turned_deg = np.degrees(Rotation.from_matrix(capture_from_sensor).magnitude())
    return grid, fused_position, fused_rotation, (np.diag(gyro_gain), np.diag(accel_gain), turned_deg)


def straight_line(values):
    """A straight line in time through the rows."""
    at = np.arange(len(values))
    return np.stack([np.polyval(np.polyfit(at, values[:, k], 1), at) for k in range(3)], 1)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("room", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", default="931")
    parser.add_argument("--size", default="480x360")
    parser.add_argument("--begin", type=float, default=0.0, help="seconds of the room to leave out")
    parser.add_argument("--duration", type=float, default=20.0)
    parser.add_argument("--vidar", default="target/release/vidar")
    args = parser.parse_args()

    mocap_ns, poses = rows(args.room / "mav0" / "mocap0" / "data.csv")
    real_ns, real = rows(args.room / "mav0" / "imu0" / "data.csv")
    # Only what is drawn, and a margin for the windows: elsewhere the motion capture has glitches.
    origin = mocap_ns[0]
    secs = 1e-9 * (mocap_ns - origin)
    near = (secs > args.begin - MARGIN_SECS) & (secs < args.begin + args.duration + MARGIN_SECS)
    mocap_ns, poses = mocap_ns[near], poses[near]
    grid, position, rotation, gains = fused_path(
        1e-9 * (mocap_ns - origin), poses, 1e-9 * (real_ns - origin), real[:, :3], real[:, 3:6])
    fused_ns = origin + np.round(1e9 * grid).astype(np.int64)
    used = grid >= args.begin
    flight = args.out.parent / f"{args.out.name}.tum"
    flight.parent.mkdir(parents=True, exist_ok=True)
    with open(flight, "w") as file:
        for t, (x, y, z), (qx, qy, qz, qw) in zip(fused_ns[used], position[used], rotation.as_quat()[used]):
            file.write(f"{t // 10**9}.{t % 10**9:09d} {x:.9f} {y:.9f} {z:.9f} {qx:.9f} {qy:.9f} {qz:.9f} {qw:.9f}\n")
    world = args.out.parent / f"{args.out.name}.toml"
    world.write_text(WORLD.format(seed=args.seed, duration=args.duration))
    subprocess.run([args.vidar, "synth", str(args.out), "--world-config", str(world), "--size", args.size, "--trajectory", str(flight)],
                   check=True)

    # Stamps of the recording begin anew; the shift is where both gyroscopes agree best, within 0.25 ms.
    imu = args.out / "mav0" / "imu0" / "data.csv"
    simulated_ns, simulated = rows(imu)
    seconds = 1e-9 * (simulated_ns - simulated_ns[0])

    def disagreement(shift):
        at = 1e-9 * (fused_ns[used][0] - real_ns[0]) + seconds + shift
        if at[-1] > 1e-9 * (real_ns[-1] - real_ns[0]):
            return np.inf
        real_rate = np.stack([np.interp(at, 1e-9 * (real_ns - real_ns[0]), real[:, k]) for k in range(3)], 1)
        difference = simulated[:, :3] - real_rate
        return float(np.sqrt(((difference - difference.mean(0)) ** 2).mean()))

    shift = min(np.arange(0.0, 1.5, 0.00025), key=disagreement)
    move = int(simulated_ns[0] - fused_ns[used][0]) - round(1e9 * shift)
    with open(imu, "w") as file:
        file.write("#timestamp [ns],w_x [rad s^-1],w_y,w_z,a_x [m s^-2],a_y,a_z\n")
        for t, values in zip(real_ns + move, real):
            if simulated_ns[0] <= t <= simulated_ns[-1]:
                file.write(f"{t}," + ",".join(f"{v:.10f}" for v in values) + "\n")
    print(f"{args.out}: the images begin {1e3 * shift:.1f} ms into the path; the gyroscopes differ by {disagreement(shift):.4f} rad/s "
          f"(RMS); gains that fit the motion capture: gyroscope {gains[0].round(4)}, accelerometer {gains[1].round(4)}; frames {gains[2]:.2f} degrees apart")


if __name__ == "__main__":
    main()
