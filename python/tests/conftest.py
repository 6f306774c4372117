"""Small rendered recordings, made once by the program that the module is compared with."""

import os
import pathlib
import subprocess

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]

# Small images, two and a half seconds; coarse voxels: a run takes about a second. Too short for the odometry to start, so
# the poses are ground truth's.
TINY = """duration_secs = 2.5
camera_rate_hz = 8.0
width = 160
height = 104
blur_samples = 1
exposure_secs = 0.0
scan_spacing_m = 0.05
"""
SETTINGS = """[input]
poses = "ground-truth"
[fusion]
voxel_size_m = 0.04
[output]
report = false
"""
# Six seconds at 20 Hz: the odometry starts and converges.
FLIGHT = """duration_secs = 6.0
camera_rate_hz = 20.0
depth = false
scan_spacing_m = 0.2
"""


def program() -> pathlib.Path:
    """The program: VIDAR_PROGRAM, or the build of the checkout."""
    named = os.environ.get("VIDAR_PROGRAM")
    path = pathlib.Path(named) if named else ROOT / "target/debug/vidar"
    if not path.is_file():
        pytest.skip(f"{path} is missing: cargo build -p vidar-cli, or set VIDAR_PROGRAM")
    return path


def call(*arguments, code=0) -> subprocess.CompletedProcess:
    """Runs the program and requires its exit code."""
    done = subprocess.run([program(), *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == code, done.stdout + done.stderr
    return done


def rendered(folder: pathlib.Path, world: str) -> pathlib.Path:
    description = folder / "world.toml"
    description.write_text(world)
    call("synth", folder / "room", "--world-config", description, "-q")
    return folder / "room"


@pytest.fixture(scope="session")
def settings(tmp_path_factory) -> pathlib.Path:
    path = tmp_path_factory.mktemp("settings") / "settings.toml"
    path.write_text(SETTINGS)
    return path


@pytest.fixture(scope="session")
def tiny(tmp_path_factory) -> pathlib.Path:
    return rendered(tmp_path_factory.mktemp("tiny"), TINY)


@pytest.fixture(scope="session")
def flight(tmp_path_factory) -> pathlib.Path:
    return rendered(tmp_path_factory.mktemp("flight"), FLIGHT)


@pytest.fixture(scope="session")
def finished(tiny, settings, tmp_path_factory) -> pathlib.Path:
    """A run of the program on the tiny recording."""
    out = tmp_path_factory.mktemp("program") / "run"
    call("run", tiny, "-o", out, "--config", settings, "-q")
    return out
