"""Functions of arrays: depth, alignment, fusion, evaluation."""

import numpy as np
import pytest
from conftest import call

import vidar


def turn(axis, angle):
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def test_an_alignment_is_found_again():
    random = np.random.default_rng(1)
    source = random.normal(size=(50, 3))
    rotation, translation = turn([1, 2, 3], 0.7), np.array([1.0, -2, 0.5])
    target = 1.7 * source @ rotation.T + translation
    found = vidar.align(source, target)
    assert found.scale == pytest.approx(1.7) and found.rmse < 1e-12 and found.pairs == 50
    assert np.allclose(found.rotation, rotation) and np.allclose(found.translation, translation)
    assert np.allclose(found.apply(source), target)
    assert np.allclose((found.matrix @ np.c_[source, np.ones(50)].T).T[:, :3], target)
    rigid = vidar.align(source, target, scale=False)
    assert rigid.scale == 1.0 and rigid.rmse > 0.1
    target[0] += 100
    weights = np.ones(50)
    weights[0] = 0
    assert vidar.align(source, target, weights=weights).scale == pytest.approx(1.7)
    with pytest.raises(vidar.VidarError) as caught:
        vidar.align(source[:2], target[:2])
    assert caught.value.code == "E0304"
    with pytest.raises(ValueError, match="shape"):
        vidar.align(source[:, :1], target)


def trajectory(scale=1.0, turned=np.eye(3), n=200, noise=0.0):
    random = np.random.default_rng(2)
    t = np.linspace(0, 8, n)
    positions = np.c_[np.sin(t), np.cos(1.3 * t), 0.4 * np.sin(2 * t)] * scale @ turned.T
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, 3] = positions + noise * random.normal(size=(n, 3))
    poses[:, :3, :3] = turned
    return vidar.Trajectory((t * 1e9).astype(np.int64), poses)


def test_trajectories_are_aligned_and_evaluated(tmp_path):
    truth, estimate = trajectory(), trajectory(1.05, turn([0, 0, 1], 0.3), noise=0.01)
    found = vidar.align(estimate, truth)
    assert found.scale == pytest.approx(1 / 1.05, abs=2e-3)
    outcome = vidar.evaluate(estimate, truth)
    assert outcome.kind == "trajectory" and outcome.scores["scale"] == pytest.approx(np.log(1.05), abs=2e-3)
    assert outcome.scores["ate-sim3"] == pytest.approx(found.rmse, rel=1e-9)
    # As files, through the program.
    import json

    truth.write(tmp_path / "truth.tum")
    estimate.write(tmp_path / "estimate.tum")
    told = json.loads(call("eval", tmp_path / "estimate.tum", tmp_path / "truth.tum", "--json").stdout)
    assert vidar.evaluate(tmp_path / "estimate.tum", tmp_path / "truth.tum").scores == told["scores"]
    assert told["scores"] == pytest.approx(outcome.scores, abs=1e-7)
    again = vidar.Trajectory.read(tmp_path / "truth.tum")
    assert np.array_equal(again.times_ns, truth.times_ns) and np.allclose(again.positions, truth.positions, atol=1e-9)
    assert again.body == "body" and np.allclose(np.linalg.norm(again.quaternions_xyzw, axis=1), 1)
    with pytest.raises(vidar.VidarError) as caught:
        vidar.evaluate(estimate, vidar.Trajectory(np.array([10**15]), np.eye(4)[None]))
    assert caught.value.code == "E0304"


def test_depth_images_become_a_surface(tmp_path):
    n, height, width = 3, 60, 80
    k = np.array([[80.0, 0, 39.5], [0, 80, 29.5], [0, 0, 1]])
    depth = np.ones((n, height, width), np.float32)
    depth[:, :5] = np.nan
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = [0, 0.01, 0.02]
    colors = np.full((n, height, width, 3), (10, 200, 30), np.uint8)
    told = []
    mesh = vidar.fuse(depth, poses, k, colors=colors, progress=told.append, settings={"fusion.voxel_size_m": 0.02})
    assert [e["done"] for e in told] == [1, 2, 3]
    assert np.abs(mesh.vertices[:, 2] - 1).max() < 1e-3 and (mesh.normals[:, 2] < -0.99).all()
    assert np.abs(mesh.colors.astype(int) - (10, 200, 30)).max() <= 1
    same = vidar.fuse(depth, poses, np.tile(k, (n, 1, 1)), colors=colors, settings={"fusion.voxel_size_m": 0.02})
    assert np.array_equal(mesh.vertices, same.vertices) and np.array_equal(mesh.triangles, same.triangles)
    scores = vidar.evaluate(mesh, mesh).scores
    assert scores["f@0.05"] == pytest.approx(1.0)
    for name in ("mesh.ply", "mesh.glb"):
        mesh.write(tmp_path / name)
    again = vidar.Mesh.read(tmp_path / "mesh.ply")
    assert np.array_equal(again.vertices, mesh.vertices) and np.array_equal(again.colors, mesh.colors)
    with pytest.raises(ValueError, match="confidence"):
        vidar.fuse(depth, poses, k, confidence=np.ones((n, 2, 2), np.float32))
    with pytest.raises(ValueError, match="2 poses for 3"):
        vidar.fuse(depth, poses[:2], k)


def test_clouds_are_evaluated():
    random = np.random.default_rng(3)
    truth = random.uniform(-1, 1, size=(4000, 3)) * (1, 1, 0)
    estimate = truth + (0, 0, 0.003)
    scores = vidar.evaluate(estimate.astype(np.float32), truth).scores
    assert scores["f@0.05"] > 0.999
    cloud = vidar.PointCloud(truth.astype(np.float32))
    assert vidar.evaluate(cloud, cloud).scores["chamfer"] == pytest.approx(0, abs=1e-6)
    with pytest.raises(TypeError):
        vidar.evaluate("a.ply", cloud)


def test_depth_is_that_of_the_program(tiny, tmp_path):
    import json

    recording = vidar.Recording(tiny)
    files = sorted((tiny / "mav0/cam0/data").glob("*.png"))[:2]
    call("depth", *files, "--model", "da3-nano", "-o", tmp_path / "out", "--format", "mini_npz", "--process-res", "112", "-q")
    network = vidar.DepthAnything3("da3-nano")
    assert network.is_any_view and "f32" in network.compute
    images = [np.repeat(recording.image(i).pixels[..., None], 3, axis=2) for i in range(2)]
    found = network.predict(images, process_size=112)
    n, height, width = found.depth.shape
    assert n == 2 and found.confidence.shape == found.depth.shape and found.images.shape == (2, height, width, 3)
    (npz,) = (tmp_path / "out").rglob("*.npz")
    told = np.load(npz)
    # The official program rounds what it writes, and so does this format.
    assert np.array_equal(told["depth"], np.round(found.depth, 8))
    assert np.array_equal(told["conf"], np.round(found.confidence, 2))
    predictions = json.loads((tmp_path / "out/predictions.json").read_text())
    for i, view in enumerate(predictions["views"]):
        assert np.allclose(found.world_from_camera[i][:3], view["world_from_camera"], atol=1e-12)
        assert found.intrinsics[i][0, 0] == pytest.approx(view["intrinsics"]["fx"], rel=1e-12)
        assert found.intrinsics[i][0, 2] == pytest.approx(view["intrinsics"]["cx"], rel=1e-12)
    # Given cameras: depth is in their unit, and the answer has the given poses.
    camera = recording.cameras[0]
    truth = recording.ground_truth
    poses = np.stack([truth.world_from_body[np.abs(truth.times_ns - t).argmin()] for t in recording.image_times_ns[[0, 6]]])
    poses = poses @ camera.body_from_camera
    images = [recording.image(i).pixels for i in (0, 6)]
    posed = network.predict(images, world_from_camera=poses, intrinsics=camera.matrix, process_size=112)
    assert np.allclose(posed.world_from_camera, poses, atol=1e-9)
    assert 0.2 < np.median(posed.depth) < 20
    with pytest.raises(vidar.VidarError) as caught:
        vidar.DepthAnything3("da3-enormous")
    assert caught.value.code == "E0105"
    with pytest.raises(vidar.VidarError) as caught:
        network.predict([])
    assert caught.value.code == "E0309"
