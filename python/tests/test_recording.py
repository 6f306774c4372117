"""Recordings: facts, events, errors."""

import numpy as np
import pytest

import vidar


def test_facts_are_those_of_the_world(tiny):
    recording = vidar.Recording(tiny)
    assert recording.kind == "euroc" and recording.name
    streams = {s["what"]: s for s in recording.streams}
    assert streams["images of camera 0"]["rate_hz"] == pytest.approx(8.0, rel=0.01)
    assert streams["IMU"]["rate_hz"] == pytest.approx(200.0, rel=0.01)
    assert recording.duration == pytest.approx(2.5, abs=0.2)
    camera = recording.cameras[recording.camera]
    assert (camera.width, camera.height) == (160, 104)
    assert camera.matrix.shape == (3, 3) and camera.matrix[0, 0] == camera.parameters["fx"]
    rotation = camera.body_from_camera[:3, :3]
    assert np.allclose(rotation @ rotation.T, np.eye(3))
    assert recording.imu_noise["rate_hz"] == 200.0
    assert recording.calibration.endswith("sensor.yaml")
    assert len(recording.ground_truth) > 100 and recording.trajectory is None
    again = vidar.Camera(camera.model, camera.width, camera.height, body_from_camera=camera.body_from_camera)
    assert again.parameters == camera.parameters


def test_events_come_in_the_order_of_time(tiny):
    recording = vidar.Recording(tiny)
    events = list(recording)
    times = [e.time_ns for e in events]
    assert times == sorted(times)
    count = lambda kind: sum(isinstance(e, kind) for e in events)
    frames = [e for e in events if isinstance(e, vidar.Frame)]
    assert [f.time_ns for f in frames] == recording.image_times_ns.tolist()
    assert count(vidar.ImuSample) == len(recording.imu[0]) and count(vidar.GroundTruth) == len(recording.ground_truth)
    assert frames[0].pixels.dtype == np.uint8 and frames[0].pixels.shape == (104, 160)
    assert np.array_equal(recording.image(3).pixels, frames[3].pixels)
    depth = next(e for e in events if isinstance(e, vidar.DepthImage)).depth
    assert depth.dtype == np.float32 and depth.shape == (104, 160) and np.nanmedian(depth) > 0.3
    sample = next(e for e in events if isinstance(e, vidar.ImuSample))
    assert np.array_equal(sample.gyro, recording.imu[1][0]) and np.array_equal(sample.accel, recording.imu[2][0])
    # Iterating again begins again.
    assert next(iter(recording)).time_ns == times[0]


def test_a_part_can_be_read(tiny):
    whole, part = vidar.Recording(tiny), vidar.Recording(tiny, start=1.0, end=2.0, stride=2)
    assert 0 < len(part.image_times_ns) < len(whole.image_times_ns) / 2
    assert part.image_times_ns[0] - whole.image_times_ns[0] >= 1_000_000_000


def test_errors_have_the_codes_of_the_program(tmp_path, tiny):
    from conftest import call
    import json

    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(vidar.VidarError) as caught:
        vidar.Recording(empty)
    error = caught.value
    told = json.loads(call("inspect", empty, "--json", "-q", code=1).stdout)
    assert (error.code, error.message, error.hint, error.exit_status) == (
        told["code"], told["message"], told["hint"], told["exit"],
    )
    assert error.where == str(empty) and error.code in str(error)
    with pytest.raises(vidar.VidarError) as caught:
        vidar.Recording(tiny, settings={"fusion.voxel_size": 0.1})
    assert caught.value.code == "E0101" and "voxel_size_m" in caught.value.hint
    with pytest.raises(vidar.VidarError) as caught:
        vidar.Recording(tiny, format="floppy")
    assert caught.value.code == "E0105"
    (empty / "mav0/cam0").mkdir(parents=True)
    with pytest.raises(vidar.VidarError) as caught:
        vidar.Trajectory.read(tmp_path / "missing.tum")
    assert caught.value.where == str(tmp_path / "missing.tum")


def test_wrong_arguments_are_type_errors(tiny):
    with pytest.raises(TypeError, match="unexpected keyword argument 'colour'"):
        vidar.Recording(tiny, colour=1)
    with pytest.raises(TypeError, match="stride|integer|whole|int"):
        vidar.Odometry(vidar.Recording(tiny).cameras[0]).push(3)
    with pytest.raises(TypeError, match="uint8 or uint16"):
        vidar.Odometry(vidar.Recording(tiny).cameras[0]).push(vidar.Frame(0, 0, np.zeros((104, 160))))
    with pytest.raises(ValueError, match="not a rigid motion"):
        vidar.Camera("pinhole:100,100,80,52", 160, 104, body_from_camera=np.diag([2.0, 1, 1, 1]))
