"""The scripts of examples/python run and check their own results."""

import importlib
import subprocess
import sys

import pytest
from conftest import ROOT

import vidar


def script(name, *arguments):
    path = ROOT / "examples/python" / name
    done = subprocess.run([sys.executable, path, *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def needs(module):
    """Skips a test where a module is not installed, or cannot be loaded for want of a system library."""
    try:
        importlib.import_module(module)
        reason = ""
    except ImportError as error:
        reason = str(error)
    return pytest.mark.skipif(bool(reason), reason=reason)


def test_own_frames(flight, tmp_path):
    said = script("own_frames.py", flight, tmp_path / "own.tum")
    scores = vidar.evaluate(vidar.Trajectory.read(tmp_path / "own.tum"), vidar.Recording(flight).ground_truth).scores
    assert scores["ate"] < 0.05 and f"ATE {scores['ate']:.4f} m" in said


@needs("evo")
def test_with_evo(flight, tmp_path):
    script("own_frames.py", flight, tmp_path / "own.tum")
    vidar.Recording(flight).ground_truth.write(tmp_path / "truth.tum")
    assert script("with_evo.py", tmp_path / "own.tum", tmp_path / "truth.tum").count("evo") == 2


@needs("open3d")
def test_with_open3d(finished, tmp_path):
    said = script("with_open3d.py", finished, tmp_path / "part.ply")
    assert "triangles" in said and len(vidar.Mesh.read(tmp_path / "part.ply").triangles) > 100


def test_to_nerfstudio(tiny, settings, tmp_path):
    said = script("to_nerfstudio.py", tiny, tmp_path / "run", tmp_path / "ns", settings)
    assert f"images in {tmp_path / 'ns'}" in said and "map done in" in said
