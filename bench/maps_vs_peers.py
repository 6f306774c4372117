#!/usr/bin/env python3
"""Maps of VIDAR beside what else runs on a processor: same keyframes, same poses, same evaluation, processor seconds.

Needs: pip install open3d-cpu==0.19.0 opencv-python-headless pycolmap numpy

  bench/maps_vs_peers.py RUN --vidar target/release/vidar --reference hololens:hololens_commonroom
  bench/maps_vs_peers.py RUN --vidar target/release/vidar --reference 7scenes:7scenes_redkitchen/seq-01
  bench/maps_vs_peers.py RUN --vidar target/release/vidar --reference cloud:roomU/mav0/pointcloud0/data.ply

RUN is a finished run of `vidar run … --geometry auto` (or stereo) with given poses. Every tool gets its undistorted keyframes, intrinsics and
poses (views.json). Depth sensors' images of the *whole* recording are fused here by Open3D (2 cm, seen three times) to the reference, which is so nobody's own.
All results are points: meshes are sampled evenly, one point for a square of 1 cm, and scored by `vidar eval` (rigid fit).

Peers:
- sgbm: each keyframe is rectified with up to PARTNERS other ones (4 to 25 % of --median-depth away, turned by less than 25 degrees, the ones that
  moved across the axis first), matched by OpenCV's StereoSGBM with the settings of OpenCV's own example (block 5, P1 = 8·5², P2 = 32·5², left-right
  1, uniqueness 10, speckles 100 and 2, all eight directions), and all depth images are fused by Open3D's VoxelBlockGrid (2 cm, truncation 8 cm, to 6 m). Its free settings (partners, least
  weight of the mesh) are tried and the row with the best F@0.05 is the peer's, with what it took.
- colmap: SIFT, all pairs, triangulation with the poses held (pycolmap); the sparse points are the cloud. A floor: nobody expects a surface of it.
Processor seconds: user and system, of this program's thread pool or of the tool's process; reading the images is included, evaluation and reference are not.
"""
import argparse
import glob
import json
import os
import resource
import shutil
import subprocess
import tempfile

os.environ.setdefault("OMP_NUM_THREADS", "2")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # so that processor time counts work, not waiting

import cv2  # noqa: E402
import numpy as np  # noqa: E402
import open3d as o3d  # noqa: E402

VOXEL, TRUNCATION_VOXELS, MAX_DEPTH = 0.02, 4.0, 6.0
SPACING = 0.01
BLOCK = 5
# Sine of the angle between baseline and axis: below it too little of the images can be rectified.
LEAST_ACROSS = 0.35


def processor_seconds(who=resource.RUSAGE_SELF):
    usage = resource.getrusage(who)
    return usage.ru_utime + usage.ru_stime


def read_views(run):
    with open(os.path.join(run, "views.json")) as f:
        views = json.load(f)["views"]
    result = []
    for v in views:
        k = v["intrinsics"]
        pose = np.vstack([np.array(v["world_from_camera"], float), [0, 0, 0, 1]])
        matrix = np.array([[k["fx"], 0, k["cx"]], [0, k["fy"], k["cy"]], [0, 0, 1]])
        result.append((os.path.join(run, v["image"]), matrix, pose, (k["width"], k["height"])))
    return result


class Volume:
    """Open3D's TSDF."""

    def __init__(self):
        o = o3d.core
        self.grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight"), (o.float32, o.float32), ((1), (1)), VOXEL, 16, 20000)

    def add(self, depth, matrix, world_from_camera):
        image = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth, np.float32)))
        k, e = o3d.core.Tensor(matrix), o3d.core.Tensor(np.linalg.inv(world_from_camera))
        blocks = self.grid.compute_unique_block_coordinates(image, k, e, 1.0, MAX_DEPTH, TRUNCATION_VOXELS)
        if len(blocks):
            self.grid.integrate(blocks, image, k, e, 1.0, MAX_DEPTH, TRUNCATION_VOXELS)

    def mesh(self, weight):
        try:
            return self.grid.extract_triangle_mesh(weight_threshold=weight).to_legacy()
        except RuntimeError:  # of an empty volume
            return o3d.geometry.TriangleMesh()


def reference(what, folder):
    """Path of the reference cloud."""
    kind, _, path = what.partition(":")
    if kind == "cloud":
        return path
    volume = Volume()
    if kind == "hololens":
        matrix = np.loadtxt(os.path.join(path, "K.txt"))
        poses = np.loadtxt(os.path.join(path, "poses.txt")).reshape(-1, 4, 4)
        frames = zip(sorted(glob.glob(os.path.join(path, "depth", "*.png"))), poses)
    elif kind == "7scenes":
        matrix = np.array([[585.0, 0, 320], [0, 585, 240], [0, 0, 1]])
        depths = sorted(glob.glob(os.path.join(path, "*.depth.png")))
        frames = ((d, np.loadtxt(d.replace("depth.png", "pose.txt"))) for d in depths)
    else:
        raise SystemExit(f"unknown kind of reference {kind!r}: hololens, 7scenes or cloud")
    for depth, pose in frames:
        raw = cv2.imread(depth, cv2.IMREAD_UNCHANGED)
        metres = np.where((raw == 0) | (raw == 65535), 0, raw / 1000.0)
        volume.add(metres, matrix, pose)
    out = os.path.join(folder, "reference.ply")
    write_points(volume.mesh(3.0), out)
    return out


def write_points(mesh, out):
    mesh.compute_vertex_normals()
    count = max(int(mesh.get_surface_area() / SPACING**2), 1)
    o3d.utility.random.seed(1)
    o3d.io.write_point_cloud(out, mesh.sample_points_uniformly(count))


def scores(vidar, cloud, truth):
    done = subprocess.run([vidar, "eval", cloud, truth, "--json", "-q"], capture_output=True, text=True)
    if done.returncode:
        return None
    report = json.loads(done.stdout)
    surface = report.get("surface", report.get("report", report))
    return surface["rigid"], surface["estimate_points"]


def row(name, vidar, cloud, truth, seconds):
    found = scores(vidar, cloud, truth)
    if found is None:
        return (name, None, f"| {name} | no result | | | | {seconds:.1f} |")
    (a, b), points = found
    text = " | ".join(f"{s['f']:.3f} ({s['precision']:.3f} / {s['recall']:.3f})" for s in (a, b))
    return (name, a["f"], f"| {name} | {text} | {points} | {seconds:.1f} |")


def rectified(first, second):
    """Rotation rectified_from_first-camera and the baseline, for a pair in which the second camera is to the right."""
    baseline = second[:3, 3] - first[:3, 3]
    length = np.linalg.norm(baseline)
    x = baseline / length
    axis = first[:3, 2] + second[:3, 2]
    z = axis - x * (axis @ x)
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z]), length


def partners(views, index, median_depth, most):
    pose = views[index][2]
    good = []
    for j, (_, _, other, _) in enumerate(views):
        baseline = other[:3, 3] - pose[:3, 3]
        length = np.linalg.norm(baseline)
        turn = np.degrees(np.arccos(np.clip((np.trace(pose[:3, :3].T @ other[:3, :3]) - 1) / 2, -1, 1)))
        if j == index or turn > 25 or not 0.04 * median_depth <= length <= 0.25 * median_depth:
            continue
        across = np.sqrt(max(1 - (baseline @ pose[:3, 2] / length) ** 2, 0))
        if across < LEAST_ACROSS:
            continue
        good.append((abs(np.log(length / (0.1 * median_depth))) + turn / 25 + 2 * (1 - across), j))
    return [j for _, j in sorted(good)[:most]]


def sgbm_depth(views, i, j, images):
    """Depth of the rectified view, its intrinsics and pose."""
    (_, k1, first, size), (_, k2, second, _) = views[i], views[j]
    world_from_rect = first.copy()
    rotation, baseline = rectified(first, second)
    world_from_rect[:3, :3] = rotation.T
    focal = k1[0, 0]
    boxes = []
    for k, pose in ((k1, first), (k2, second)):
        u, v = np.meshgrid(np.linspace(0, size[0], 41), np.linspace(0, size[1], 41))
        rays = rotation @ pose[:3, :3] @ np.linalg.inv(k) @ np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
        # Motion along the axis turns the image plane; what it sees under more than 68 degrees is left out.
        seen = rays[:, rays[2] > 0.37 * np.linalg.norm(rays, axis=0)]
        if seen.shape[1] == 0:
            return None
        flat = focal * seen[:2] / seen[2]
        boxes.append((flat.min(1), flat.max(1)))
    (low1, high1), (low2, high2) = boxes
    low = np.array([min(low1[0], low2[0]), max(low1[1], low2[1])])
    high = np.array([max(high1[0], high2[0]), min(high1[1], high2[1])])
    if (high - low < 32).any():
        return None
    width, height = np.ceil(high - low).astype(int)
    k = np.array([[focal, 0, -low[0]], [0, focal, -low[1]], [0, 0, 1.0]])
    warped = []
    for image, own, pose in ((images[i], k1, first), (images[j], k2, second)):
        h = k @ rotation @ pose[:3, :3] @ np.linalg.inv(own)
        warped.append(cv2.warpPerspective(image, h, (int(width), int(height)), flags=cv2.INTER_LINEAR))
    # Depth from 0.4 m on.
    levels = int(np.ceil(focal * baseline / 0.4 / 16) * 16)
    matcher = cv2.StereoSGBM_create(
        minDisparity=0, numDisparities=max(levels, 16), blockSize=BLOCK, P1=8 * BLOCK**2, P2=32 * BLOCK**2,
        disp12MaxDiff=1, uniquenessRatio=10, speckleWindowSize=100, speckleRange=2, preFilterCap=63,
        mode=cv2.STEREO_SGBM_MODE_HH)
    disparity = matcher.compute(*warped).astype(np.float32) / 16
    depth = np.where(disparity > 0.5, focal * baseline / np.maximum(disparity, 0.5), 0)
    depth[warped[0] == 0] = 0
    return depth.astype(np.float32), k, world_from_rect


def sgbm(views, most, median_depth):
    before = processor_seconds()
    images = [cv2.imread(v[0], cv2.IMREAD_GRAYSCALE) for v in views]
    volume, pairs = Volume(), 0
    for i in range(len(views)):
        for j in partners(views, i, median_depth, most):
            found = sgbm_depth(views, i, j, images)
            if found is not None:
                volume.add(*found)
                pairs += 1
    return volume, pairs, processor_seconds() - before


def best_sgbm(views, vidar, truth, folder, median_depth):
    rows = []
    for most in (1, 2):
        volume, pairs, seconds = sgbm(views, most, median_depth)
        for weight in (1.0, 2.0, 3.0, 5.0):
            before = processor_seconds()
            mesh = volume.mesh(weight)
            took = seconds + processor_seconds() - before
            if not len(mesh.triangles):
                continue
            cloud = os.path.join(folder, "sgbm.ply")
            write_points(mesh, cloud)
            name = f"SGBM + TSDF ({most} a keyframe, {pairs} pairs, weight {weight:.0f})"
            rows.append(row(name, vidar, cloud, truth, took))
            print("tried:", rows[-1][2], flush=True)
    return max(rows, key=lambda r: r[1] or 0)


def colmap(views, vidar, truth, folder):
    import pycolmap

    before = processor_seconds()
    images = os.path.join(folder, "images")
    os.makedirs(images)
    for n, v in enumerate(views):
        shutil.copy(v[0], os.path.join(images, f"{n:06}.png"))
    database = os.path.join(folder, "colmap.db")
    _, k, _, (width, height) = views[0]
    # COLMAP's centre of the first pixel is (0.5, 0.5).
    parameters = f"{k[0, 0]},{k[1, 1]},{k[0, 2] + 0.5},{k[1, 2] + 0.5}"
    reader = pycolmap.ImageReaderOptions(camera_model="PINHOLE", camera_params=parameters)
    pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
                              device=pycolmap.Device.cpu)
    pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    known = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as db:
        for camera in db.read_all_cameras():
            known.add_camera_with_trivial_rig(camera)
        for image in db.read_all_images():
            pose = np.linalg.inv(views[int(image.name[:6])][2])
            move = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3])
            known.add_image_with_trivial_frame(image, move)
    out = os.path.join(folder, "sparse")
    os.makedirs(out)
    options = pycolmap.IncrementalPipelineOptions(ba_refine_focal_length=False, ba_refine_extra_params=False)
    made = pycolmap.triangulate_points(known, database, images, out, options=options)
    seconds = processor_seconds() - before
    points = np.array([p.xyz for p in made.points3D.values()])
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    path = os.path.join(folder, "colmap.ply")
    o3d.io.write_point_cloud(path, cloud)
    return row(f"COLMAP, sparse ({len(points)} points)", vidar, path, truth, seconds)


def ours(run, vidar, truth, folder):
    """The map of the run, and the time of the same run without evaluation, report and pictures."""
    mesh = o3d.io.read_triangle_mesh(os.path.join(run, "map", "mesh.ply"))
    cloud = os.path.join(folder, "vidar.ply")
    write_points(mesh, cloud)
    with open(os.path.join(run, "manifest.json")) as f:
        command = json.load(f)["command"]
    command = [vidar] + [a for a in command[1:]]
    if "-o" in command:
        at = command.index("-o")
        del command[at:at + 2]
    off = ["eval.mode=off", "output.report=false", "output.mesh_glb=false", "output.images=false", "output.depth_png=false"]
    command += [a for s in off for a in ("--set", s)] + ["-o", os.path.join(folder, "again"), "-q"]
    before = processor_seconds(resource.RUSAGE_CHILDREN)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    subprocess.run(command, check=True, env={**os.environ, "RAYON_NUM_THREADS": "2"}, **quiet)
    seconds = processor_seconds(resource.RUSAGE_CHILDREN) - before
    return row("VIDAR", vidar, cloud, truth, seconds)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("--vidar", default="target/release/vidar")
    parser.add_argument("--reference", required=True)
    parser.add_argument("--median-depth", type=float, default=2.5, help="metres, for the choice of pairs")
    parser.add_argument("--skip", default="", help="rows to leave out: vidar,sgbm,colmap")
    args = parser.parse_args()
    skip = args.skip.split(",")
    views = read_views(args.run)
    cv2.setNumThreads(2)
    with tempfile.TemporaryDirectory() as folder:
        truth = reference(args.reference, folder)
        rows = []
        if "vidar" not in skip:
            rows.append(ours(args.run, args.vidar, truth, folder))
        if "sgbm" not in skip:
            rows.append(best_sgbm(views, args.vidar, truth, folder, args.median_depth))
        if "colmap" not in skip:
            rows.append(colmap(views, args.vidar, truth, folder))
        print(f"\n{len(views)} keyframes\n")
        print("| tool | F@0.05 (P / R) | F@0.10 (P / R) | points | processor time, s |\n|---|---|---|--:|--:|")
        print("\n".join(r[2] for r in rows))


if __name__ == "__main__":
    main()
