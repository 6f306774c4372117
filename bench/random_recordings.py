"""Prints `vidar synth` commands of recordings drawn at random: presets, scenes, flights, sizes, rates, clocks, readouts, calibrations.

    python bench/random_recordings.py OUT [--count 20] [--seed 20261127] [--lively | --devices] > commands.sh
    sh commands.sh && for r in OUT/*/; do vidar odometry $r -o runs/$(basename $r); done

The defaults give the twenty of docs/benchmark/odometry.md, `--count 12 --seed 1127 --lively` the twelve. `--devices` draws what
presets hold fixed: lens, portrait or landscape, rates and noise of the IMU, exposure, compression, missing and repeated images.
"""

import argparse
import random

PRESETS = ["phone-slow", "phone-fast", "realsense"]
SIZES = ["320x240", "424x240", "480x360", "640x480"]


def ordinary(r: random.Random) -> str:
    """A recording of any kind."""
    preset = r.choice(PRESETS)
    flight = r.choice(["", "", "", "--flight sweep", "--flight orbit", "--flight handheld-lively"])
    scene = r.choice(["room", "room", "hall", "corridor"])
    size = r.choice(SIZES)
    rate = r.choice([10, 15, 20, 30])
    device = f"--readout-ms {r.randint(0, 30)} --stamp-delay-ms={r.randint(-80, 80)}"
    calibration = r.choice(["given", "given", "partial", "absent"])
    seed = r.randint(5000, 9999)
    rest = f"{r.choice(['', '', '--static-start 2'])} {r.choice(['', '', '--bare-share 0.4'])}"
    return command(preset, scene, flight, seed, size, rate, device, calibration, rest)


def lively(r: random.Random) -> str:
    """A recording of a lively or steady hand at low rates."""
    preset = r.choice(["phone-fast", "phone-fast", "realsense", "phone-slow"])
    flight = r.choice(["", "--flight handheld-lively", "--flight aggressive", "--flight orbit"])
    scene = r.choice(["room", "hall", "corridor"])
    size = r.choice(SIZES)
    rate = r.choice([10, 12, 15, 20, 30])
    device = f"--readout-ms {r.randint(0, 30)} --stamp-delay-ms={r.randint(-80, 80)}"
    calibration = r.choice(["given", "given", "given", "absent"])
    seed = r.randint(10000, 99999)
    rest = r.choice(["", "--bare-share 0.3"])
    return command(preset, scene, flight, seed, size, rate, device, calibration, rest)


def device(r: random.Random, out: str) -> str:
    """A recording by any device: a world of its own, written beside the recording."""
    width, height = r.choice([(640, 480), (480, 640), (640, 360), (360, 640), (848, 480), (752, 480)])
    long_side = max(width, height)
    # Fields of view of 46 to 96 degrees over the longer side; wide lenses are distorted like barrels.
    focal = r.uniform(0.45, 1.15)
    k1 = r.uniform(-0.3, -0.1) if focal < 0.6 else r.uniform(-0.15, 0.1)
    flight = r.choice(["handheld", "handheld", "handheld-lively", "sweep", "orbit", "aggressive"])
    start = r.choice(['"in-flight"', '"in-flight"', "{ static = { secs = %.1f } }" % r.uniform(0.5, 4.0)])
    noise = r.choice([0.3, 1.0, 1.0, 2.0])
    top = {
        "seed": r.randint(10000, 99999),
        "scene": '"%s"' % r.choice(["room", "room", "hall", "corridor"]),
        "variety": '"%s"' % r.choice(["standard", "randomized", "home"]),
        "flight": f'"{flight}"',
        "start": start,
        "duration_secs": 20.0,
        "camera_rate_hz": float(r.choice([10, 15, 20, 24, 30])),
        "imu_rate_hz": float(r.choice([60, 100, 200, 400])),
        "width": width,
        "height": height,
        "exposure_secs": round(r.uniform(0.002, 0.02), 4),
        "exposure_drift": 0.3,
        "image_noise_sigma": round(r.uniform(1.0, 6.0), 1),
        "vignetting": round(r.uniform(0.0, 0.5), 2),
        "depth": "false",
        "scan_spacing_m": 0.05,
        "bare_share": r.choice([0.0, 0.0, 0.3, 0.5]),
        "initial_gyro_bias_rad_per_s": 0.01,
        "initial_accel_bias_m_per_s2": 0.1,
    }
    imu = {
        "rate_hz": top["imu_rate_hz"],
        "gyro_noise_density": 5e-4 * noise,
        "gyro_random_walk": 2e-5 * noise,
        "accel_noise_density": 5e-3 * noise,
        "accel_random_walk": 1e-3 * noise,
    }
    parts = {
        "mount": '"any-axes"',
        "readout_secs": round(r.choice([0.0, r.uniform(0.005, 0.033)]), 4),
        "stamp_delay_secs": round(r.uniform(-0.1, 0.1), 4),
        "stamp_scatter_secs": r.choice([0.0, 0.0, 0.0, 0.003]),
        "stabilisation": r.choice([0.0, 0.0, 0.0, 0.0, 0.8]),
        "frame_jitter": r.choice([0.0, 0.01, 0.1]),
        "dropped_frames": r.choice([0.0, 0.0, 0.05]),
        "repeated_frames": r.choice([0.0, 0.0, 0.03]),
        "jpeg_quality": r.choice([0, 50, 75, 90]),
        "imu_timing": '"%s"' % r.choice(["regular", "jittered", "interleaved"]),
        "imu_gaps_per_min": r.choice([0.0, 0.0, 6.0]),
        "imu_scale_sigma": 0.005,
        "stated_noise_factor": r.choice([1.0, 1.0, 10.0]),
        "calibration": '"%s"' % r.choice(["given", "partial", "absent"]),
    }
    lens = {
        "focal_px": round(focal * long_side, 1),
        "centre_offset_px": [round(r.gauss(0.0, 0.008) * long_side, 1) for _ in range(2)],
        "distortion": [round(k1, 4), round(-0.35 * k1, 4), round(r.gauss(0.0, 5e-4), 5), round(r.gauss(0.0, 5e-4), 5)],
    }
    tables = {"": top, "imu_noise": imu, "device": parts, "device.lens.radtan": lens}
    lines = [
        line
        for name, table in tables.items()
        for line in ([f"[{name}]"] if name else []) + [f"{key} = {value}" for key, value in table.items()]
    ]
    world = f"{out}.toml"
    text = "\n".join(lines)
    return f"cat > {world} <<'END'\n{text}\nEND\nvidar synth {out} --world-config {world}"


def command(
    preset: str, scene: str, flight: str, seed: int, size: str, rate: int, device: str, calibration: str, rest: str
) -> str:
    """Its options."""
    options = f"--preset {preset} --scene {scene} {flight} --seed {seed} --size {size} --frame-rate {rate} {device}"
    return " ".join(f"{options} --calibration {calibration} {rest} --duration 20".split())


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", help="folder of the recordings")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=20261127)
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--lively", action="store_true")
    kind.add_argument("--devices", action="store_true")
    arguments = parser.parse_args()
    r = random.Random(arguments.seed)
    for k in range(arguments.count):
        out = f"{arguments.out}/{k:02d}"
        if arguments.devices:
            print(device(r, out))
        else:
            print(f"vidar synth {out} {lively(r) if arguments.lively else ordinary(r)}")


if __name__ == "__main__":
    main()
