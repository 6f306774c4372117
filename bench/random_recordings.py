"""Prints `vidar synth` commands of recordings drawn at random: presets, scenes, flights, sizes, rates, clocks, readouts, calibrations.

    python bench/random_recordings.py OUT [--count 20] [--seed 20261127] [--lively] > commands.sh
    sh commands.sh && for r in OUT/*; do vidar odometry $r -o runs/$(basename $r); done

The defaults give the twenty of docs/benchmark/odometry.md, `--count 12 --seed 1127 --lively` the twelve.
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
    parser.add_argument("--lively", action="store_true")
    arguments = parser.parse_args()
    r = random.Random(arguments.seed)
    draw = lively if arguments.lively else ordinary
    for k in range(arguments.count):
        print(f"vidar synth {arguments.out}/{k:02d} {draw(r)}")


if __name__ == "__main__":
    main()
