"""Numbers and files against other programs: evo, Open3D, trimesh, pycolmap, Khronos' glTF validator.

Each is skipped where its program is not installed; requirements-interchange.txt lists those of Python.
"""

import json
import shutil
import subprocess

import numpy as np
import pytest
from conftest import call

import vidar


def required(module):
    """The module, or a skipped test where it is not installed or lacks a system library."""
    return pytest.importorskip(module, exc_type=ImportError)


# Coarse voxels; the poses are those of the odometry, so that no number is zero.
COARSE = """[fusion]
voxel_size_m = 0.04
[output]
report = false
"""


@pytest.fixture(scope="module")
def mapped(flight, tmp_path_factory):
    """A run whose trajectory and map have errors: poses by odometry, depth by stereo.

    The poses come from a file, because a run that tracks also adjusts where the camera is on the body, and evaluates that
    camera, of which other programs know nothing.
    """
    folder = tmp_path_factory.mktemp("mapped")
    (folder / "coarse.toml").write_text(COARSE)
    call("odometry", flight, "-o", folder / "odometry", "-q")
    poses = folder / "odometry/trajectory/odometry_body.tum"
    call("run", flight, "-o", folder / "run", "--config", folder / "coarse.toml", "--trajectory", poses, "-q")
    return folder / "run"


@pytest.fixture(scope="module")
def trajectories(mapped, flight, tmp_path_factory):
    """Files of an estimate and of the truth, of one body: the camera of the run."""
    from evo.tools import file_interface

    folder = tmp_path_factory.mktemp("trajectories")
    recording = vidar.Recording(flight)
    recording.ground_truth.write(folder / "truth_body.tum")
    truth = file_interface.read_tum_trajectory_file(folder / "truth_body.tum")
    truth.transform(recording.cameras[0].body_from_camera, right_mul=True)
    file_interface.write_tum_trajectory_file(folder / "truth.tum", truth)
    # VIDAR refuses to compare poses of different bodies; its files name theirs in the first line.
    name = (mapped / "trajectory/metric_camera.tum").read_text().splitlines()[0]
    (folder / "truth.tum").write_text(f"{name}\n{(folder / 'truth.tum').read_text()}")
    return mapped / "trajectory/metric_camera.tum", folder / "truth.tum"


STATISTICS = ("rmse", "mean", "median", "std", "min", "max")


def assert_equals_evo(report, truth_file, estimate_file, tolerance):
    """Every statistic that VIDAR reports of a trajectory is evo's of the same two files."""
    import copy

    from evo.core import metrics, sync
    from evo.tools import file_interface

    truth, estimate = sync.associate_trajectories(
        file_interface.read_tum_trajectory_file(truth_file),
        file_interface.read_tum_trajectory_file(estimate_file),
        max_diff=0.01,
    )
    assert report["matched"] == truth.num_poses > 50
    translation, rotation = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg

    def compare(told, metric, estimate):
        metric.process_data((truth, estimate))
        evo = metric.get_all_statistics()
        for statistic in STATISTICS:
            assert told[statistic] == pytest.approx(evo[statistic], abs=tolerance), (metric, statistic)

    for name, with_scale in (("ate_se3_m", False), ("ate_sim3_m", True)):
        moved = copy.deepcopy(estimate)
        _, _, scale = moved.align(truth, correct_scale=with_scale)
        compare(report[name], metrics.APE(translation), moved)
        if with_scale:
            assert report["scale"] == pytest.approx(scale, abs=tolerance)
            assert report["scale_error"] == pytest.approx(abs(np.log(scale)), abs=tolerance)
        else:
            # An angle of a fifth of a degree is the arc cosine of nearly one: half of the digits are lost.
            compare_degrees = metrics.APE(rotation)
            compare_degrees.process_data((truth, moved))
            told = compare_degrees.get_all_statistics()
            for statistic in STATISTICS:
                assert report["orientation_se3_deg"][statistic] == pytest.approx(told[statistic], abs=1e-5)
    frames = {"delta": 1, "delta_unit": metrics.Unit.frames}
    compare(report["rpe_frames"]["translation_m"], metrics.RPE(translation, **frames), estimate)
    rpe = metrics.RPE(rotation, **frames)
    rpe.process_data((truth, estimate))
    for statistic, value in rpe.get_all_statistics().items():
        if statistic in STATISTICS:
            assert report["rpe_frames"]["rotation_deg"][statistic] == pytest.approx(value, abs=1e-5)


def test_trajectory_scores_are_those_of_evo(mapped, flight, request):
    required("evo.core")
    estimate_file, truth_file = request.getfixturevalue("trajectories")
    from_python = vidar.evaluate(estimate_file, truth_file)
    from_program = json.loads(call("eval", estimate_file, truth_file, "--json").stdout)
    assert from_python.scores == from_program["scores"] and from_python.report == from_program["report"]
    assert_equals_evo(from_python.report, truth_file, estimate_file, 1e-9)
    # What the run wrote itself, with the truth of the recording instead of a file of it, and what `vidar eval` says of the run.
    written = json.loads((mapped / "eval/metrics.json").read_text())
    assert json.loads(call("eval", mapped, "--json").stdout)["scores"] == written["scores"]
    assert_equals_evo(written["evaluation"]["metric_trajectory"], truth_file, estimate_file, 1e-6)


def matrix_of(record):
    """The 4×4 matrix of a transform in a report."""
    x, y, z, w = record["rotation_xyzw"]
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])
    matrix = np.eye(4)
    matrix[:3, :3] = record["scale"] * rotation
    matrix[:3, 3] = record["translation_m"]
    return matrix


def test_map_scores_are_those_of_open3d(mapped, flight):
    o3d = required("open3d")
    points = mapped / "map/points.ply"
    scan = vidar.Recording(flight).reference_cloud
    evaluation = vidar.evaluate(points, scan)
    told = json.loads(call("eval", points, scan, "--json").stdout)
    assert evaluation.scores == told["scores"]
    # The same placement, then Open3D's own distances.
    estimate = o3d.io.read_point_cloud(str(points)).transform(matrix_of(evaluation.report["rigid_placement"]))
    truth = o3d.io.read_point_cloud(str(scan))
    accuracy = np.asarray(estimate.compute_point_cloud_distance(truth))
    completeness = np.asarray(truth.compute_point_cloud_distance(estimate))
    for score in evaluation.report["rigid"]:
        precision = (accuracy < score["threshold_m"]).mean()
        recall = (completeness < score["threshold_m"]).mean()
        # Distances are float32 in VIDAR: a point at the threshold may fall on either side.
        assert score["precision"] == pytest.approx(precision, abs=2e-4)
        assert score["recall"] == pytest.approx(recall, abs=2e-4)
        assert score["f"] == pytest.approx(2 * precision * recall / (precision + recall), abs=2e-4)
    chamfer = evaluation.report["chamfer"]
    assert chamfer["accuracy_mean_m"] == pytest.approx(accuracy.mean(), abs=1e-6)
    assert chamfer["completeness_mean_m"] == pytest.approx(completeness.mean(), abs=1e-6)


def test_meshes_of_a_run_with_odometry_open_as_those_of_the_program(mapped):
    """Open3D, trimesh and VIDAR read the same number of triangles and the same extent from both files."""
    o3d, trimesh = required("open3d"), required("trimesh")
    mesh = vidar.read_run(mapped).mesh
    assert len(mesh.triangles) > 10_000
    extent = mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)
    for name, axes in (("mesh.ply", [0, 1, 2]), ("mesh.glb", [0, 2, 1])):
        path = mapped / "map" / name
        opened = o3d.io.read_triangle_mesh(str(path))
        scene = trimesh.load(path, process=False)
        (other,) = scene.dump() if hasattr(scene, "dump") else [scene]
        assert len(opened.triangles) == len(other.faces) == len(mesh.triangles), name
        assert np.allclose(np.ptp(np.asarray(other.vertices), axis=0), extent[axes], atol=1e-4), name


def test_meshes_open_in_open3d(finished):
    o3d = required("open3d")
    mesh = vidar.read_run(finished).mesh
    for name in ("mesh.ply", "mesh.glb"):
        opened = o3d.io.read_triangle_mesh(str(finished / "map" / name))
        assert len(opened.triangles) == len(mesh.triangles), name
        assert opened.has_vertex_normals() and opened.has_vertex_colors(), name
    opened = o3d.io.read_triangle_mesh(str(finished / "map/mesh.ply"))
    assert np.array_equal(np.asarray(opened.vertices, np.float32), mesh.vertices)
    cloud = o3d.io.read_point_cloud(str(finished / "map/points.ply"))
    assert len(cloud.points) == len(vidar.read_run(finished).points) and cloud.has_normals() and cloud.has_colors()


def test_meshes_open_in_trimesh(finished):
    trimesh = required("trimesh")
    mesh = vidar.read_run(finished).mesh
    ply = trimesh.load(finished / "map/mesh.ply", process=False)
    assert np.array_equal(ply.vertices.astype(np.float32), mesh.vertices)
    assert np.array_equal(ply.faces, mesh.triangles)
    assert np.array_equal(ply.visual.vertex_colors[:, :3], mesh.colors)
    scene = trimesh.load(finished / "map/mesh.glb", process=False)
    (glb,) = scene.dump() if hasattr(scene, "dump") else [scene]
    assert len(glb.faces) == len(mesh.triangles)
    # y up: (x, y, z) of the world is (x, z, -y) of glTF, by the root node.
    assert np.allclose(glb.vertices, mesh.vertices[:, [0, 2, 1]] * (1, 1, -1), atol=1e-5)
    assert glb.area == pytest.approx(ply.area, rel=1e-5)


@pytest.mark.parametrize("target", ["colmap", "colmap-text"])
def test_models_open_in_pycolmap(finished, tmp_path, target):
    pycolmap = required("pycolmap")
    run = vidar.read_run(finished)
    run.export(target, tmp_path, tracks=True)
    model = pycolmap.Reconstruction(tmp_path / "sparse/0")
    views = run.views
    assert model.num_images() == len(views) and model.num_points3D() > 500
    files = {p.name for p in (tmp_path / "images").iterdir()}
    assert {image.name for image in model.images.values()} == files
    errors = []
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        camera_from_world = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        for observation in image.points2D:
            if observation.has_point3D():
                point = model.points3D[observation.point3D_id].xyz
                projected = camera.img_from_cam(camera_from_world * point)
                errors.append(np.linalg.norm(projected - observation.xy))
    assert len(errors) > 1000 and max(errors) < 0.5, (len(errors), max(errors))
    # And by COLMAP's own figure, which it computes of the model as opened.
    model.update_point_3d_errors()
    assert 0 < model.compute_mean_reprojection_error() < 0.5
    # Poses are those of the run: camera centres in metres, in one world.
    centres = np.array([image.projection_center() for image in model.images.values()])
    ours = np.array([view.world_from_camera[:3, 3] for view in views])
    assert all(np.linalg.norm(ours - centre, axis=1).min() < 1e-6 for centre in centres)


VALIDATE = """
const validator = require('gltf-validator');
const bytes = new Uint8Array(require('fs').readFileSync(process.argv[2]));
validator.validateBytes(bytes, {maxIssues: 20}).then(report => console.log(JSON.stringify(report.issues)));
"""


@pytest.fixture(scope="session")
def validator(tmp_path_factory):
    """Errors and warnings of a file by the validator of Khronos; skipped, with the reason, where npm cannot install it."""
    missing = [tool for tool in ("node", "npm") if not shutil.which(tool)]
    if missing:
        pytest.skip(f"GLB files are NOT validated: there is no {' and no '.join(missing)}")
    folder = tmp_path_factory.mktemp("gltf")
    installed = subprocess.run(
        ["npm", "install", "--silent", "--no-audit", "--no-fund", "gltf-validator@2.0.0-dev.3.10"],
        cwd=folder, capture_output=True, text=True,
    )
    if installed.returncode != 0:
        pytest.skip(f"GLB files are NOT validated: npm cannot install gltf-validator: {installed.stderr.strip()[:200]}")
    (folder / "validate.js").write_text(VALIDATE)

    def validate(path):
        done = subprocess.run(["node", "validate.js", str(path)], cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return validate


def test_the_validator_finds_a_broken_file(finished, validator, tmp_path):
    data = bytearray((finished / "map/mesh.glb").read_bytes())
    at = data.index(b'"componentType":5126')
    data[at : at + 20] = b'"componentType":5122'
    (tmp_path / "broken.glb").write_bytes(data)
    assert validator(tmp_path / "broken.glb")["numErrors"] > 0


def test_glb_files_are_valid(finished, validator, tmp_path):
    run = vidar.read_run(finished)
    vidar.Mesh(run.mesh.vertices, run.mesh.triangles).write(tmp_path / "plain.glb")
    # Points and camera frustums, as the official program of Depth Anything 3 shows a prediction.
    images = sorted((finished / "images").iterdir())[:2]
    call("depth", *images, "--model", "da3-nano", "-o", tmp_path / "depth", "--format", "glb", "--process-res", "112", "-q")
    (textured,) = run.export("textured-glb", tmp_path / "textured")
    for path in (finished / "map/mesh.glb", tmp_path / "plain.glb", tmp_path / "depth/scene.glb", textured):
        issues = validator(path)
        assert issues["numErrors"] == 0 and issues["numWarnings"] == 0, (path.name, issues["messages"])
