"""The odometry pushed from Python has the same bits as the program's."""

import json

import numpy as np
import pytest
from conftest import call

import vidar


@pytest.fixture(scope="module")
def states(flight):
    recording = vidar.Recording(flight)
    odometry = vidar.Odometry.of(recording)
    states = [s for s in map(odometry.push, recording) if s is not None] + odometry.finish()
    assert odometry.counts["images"] == len(recording.image_times_ns) == len(states)
    return states


def test_states_have_poses_and_covariances(flight, states):
    metric = [s for s in states if s.is_metric]
    assert len(metric) > len(states) / 2
    last = metric[-1]
    assert last.status == "tracking" and last.reason is None and 0 < last.scale_std < 0.05
    assert last.covariance.shape == (15, 15) and np.all(np.linalg.eigvalsh(last.covariance) > 0)
    assert last.velocity.shape == last.gyro_bias.shape == last.accel_bias.shape == (3,)
    assert last.landmarks.shape[1] == 4 and len(last.landmarks) > 20
    first = states[0]
    assert first.status == "waiting" and first.reason and first.world_from_body is None

    estimate = vidar.Trajectory(
        np.array([s.time_ns for s in metric]), np.stack([s.world_from_body for s in metric])
    )
    scores = vidar.evaluate(estimate, vidar.Recording(flight).ground_truth).scores
    assert scores["ate"] < 0.05 and scores["scale"] < 0.05


def test_the_program_writes_the_same_states(flight, states, tmp_path):
    call("odometry", flight, "-o", tmp_path / "run", "-q")
    # health.csv holds one row for every image, in the order of time.
    keyframes = json.loads((tmp_path / "run/odometry/keyframes.json").read_text())["keyframes"]
    by_time = {s.time_ns: s for s in states}
    assert len(keyframes) > 5
    compared = 0
    written = vidar.Trajectory.read(tmp_path / "run/trajectory/odometry_body.tum")
    for time, pose in zip(written.times_ns.tolist(), written.world_from_body):
        state = by_time[time]
        # The file holds nine decimals.
        assert np.abs(state.world_from_body - pose).max() < 5e-9
        compared += 1
    assert compared > len(states) / 2
    made = {k["time_ns"] for k in keyframes}
    assert made == {s.time_ns for s in states if s.is_keyframe}


def test_own_frames_and_samples_give_the_same_states(flight, states):
    recording = vidar.Recording(flight)
    camera = recording.cameras[0]
    own = vidar.Camera(
        camera.model, camera.width, camera.height, body_from_camera=camera.body_from_camera, time_offset=camera.time_offset
    )
    odometry = vidar.Odometry(own, vidar.ImuNoise(**recording.imu_noise))
    found = []
    for event in recording:
        if isinstance(event, vidar.Frame):
            # A view that is not contiguous, as of a part of a larger image.
            large = np.zeros((camera.height, camera.width + 7), np.uint8)
            large[:, 3:-4] = event.pixels
            event = vidar.Frame(event.frame, event.time_ns, large[:, 3:-4])
        elif isinstance(event, vidar.ImuSample):
            event = vidar.ImuSample(event.time_ns, event.gyro.tolist(), event.accel)
        found.append(odometry.push(event))
    found = [s for s in found if s is not None] + odometry.finish()
    assert len(found) == len(states)
    # The recording's rig is rebuilt from text and matrices, so the last bits may differ.
    metric = sum(s.is_metric for s in found)
    assert metric >= len(states) / 2


def test_without_an_imu_lengths_are_not_metres(flight):
    odometry = vidar.Odometry(vidar.Recording(flight).cameras[0], settings={"odometry.max_landmarks": 60})
    for event in vidar.Recording(flight, end=1.0):
        state = odometry.push(event)
        assert state is None or not state.is_metric
    with pytest.raises(vidar.VidarError) as caught:
        vidar.Odometry(vidar.Recording(flight).cameras[0], settings={"odometry.max_landmarks": 1})
    assert caught.value.code in ("E0102", "E0310")
