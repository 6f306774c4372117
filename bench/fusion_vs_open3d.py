#!/usr/bin/env python3
"""Fuses the same depth frames with vidar-fusion and with Open3D, in turns, and compares time and result.

Needs: pip install open3d-cpu==0.19.0 numpy pillow
(the ScalableTSDFVolume of the 0.20.0 wheel returns empty meshes, which this script reports).

  cargo build --release -p vidar-fusion --example fuse_folder
  python bench/fusion_vs_open3d.py SEQUENCE_DIR --binary target/release/examples/fuse_folder --out fusion.md

Every tool gets the same frames in memory, two threads, the same voxel, truncation and range, and no minimal
number of views, and ours no limit of the viewing angle; reading files is not timed. Rounds alternate between the
tools; medians over rounds of the median frame (of the mean frame for processor time) are given.
Quality: distances from the vertices of one mesh to the triangles of the other, both ways (vertices lie on the edges
of the voxel lattice, and that of ScalableTSDFVolume is half a voxel beside the others', so distances between vertices
would measure the lattices), and how many vertices of each mesh any frame supports: a vertex is supported when some frame measured a depth within one voxel of the vertex's own z.
"""
import argparse
import glob
import json
import os
import resource
import subprocess
import sys
import tempfile
import time

THREADS = "2"
os.environ["OMP_NUM_THREADS"] = THREADS
os.environ["OMP_WAIT_POLICY"] = "passive"  # so that processor time counts work, not waiting

import numpy as np  # noqa: E402
import open3d as o3d  # noqa: E402
from PIL import Image  # noqa: E402

FOCAL, CX, CY, WIDTH, HEIGHT = 585.0, 320.0, 240.0, 640, 480
VOXEL, TRUNC_VOXELS, MAX_DEPTH = 0.02, 4.0, 6.0


def read(folder, count, color):
    frames = []
    for path in sorted(glob.glob(os.path.join(folder, "*.depth.png")))[:count]:
        depth = np.array(Image.open(path))
        depth = np.where(depth == 65535, 0, depth).astype(np.uint16)
        world_from_camera = np.loadtxt(path.replace("depth.png", "pose.txt"))
        rgb = np.array(Image.open(path.replace("depth.png", "color.jpg"))) if color else None
        frames.append((depth, rgb, np.linalg.inv(world_from_camera)))
    return frames


def scalable(frames, color):
    kind = o3d.pipelines.integration.TSDFVolumeColorType
    volume = o3d.pipelines.integration.ScalableTSDFVolume(
        voxel_length=VOXEL, sdf_trunc=VOXEL * TRUNC_VOXELS, color_type=kind.RGB8 if color else kind.NoColor)
    k = o3d.camera.PinholeCameraIntrinsic(WIDTH, HEIGHT, FOCAL, FOCAL, CX, CY)
    blank = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    ms, cpu = [], []
    for depth, rgb, camera_from_world in frames:
        rgbd = o3d.geometry.RGBDImage.create_from_color_and_depth(
            o3d.geometry.Image(rgb if color else blank), o3d.geometry.Image(depth), 1000.0, MAX_DEPTH, False)
        start, used = time.perf_counter(), time.process_time()
        volume.integrate(rgbd, k, camera_from_world)
        ms.append(1e3 * (time.perf_counter() - start))
        cpu.append(1e3 * (time.process_time() - used))
    start = time.perf_counter()
    mesh = volume.extract_triangle_mesh()
    return np.median(ms), np.mean(cpu), 1e3 * (time.perf_counter() - start), (
        np.asarray(mesh.vertices, np.float32), np.asarray(mesh.triangles, np.uint32))


def voxel_block_grid(frames, color):
    core = o3d.core
    device = core.Device("CPU:0")
    names, types, shapes = ["tsdf", "weight"], [core.float32, core.float32], [(1), (1)]
    if color:
        names, types, shapes = names + ["color"], types + [core.float32], shapes + [(3)]
    grid = o3d.t.geometry.VoxelBlockGrid(tuple(names), tuple(types), tuple(shapes), VOXEL, 8, 20000, device)
    k = core.Tensor([[FOCAL, 0, CX], [0, FOCAL, CY], [0, 0, 1.0]])
    ms, cpu = [], []
    for depth, rgb, camera_from_world in frames:
        depth = o3d.t.geometry.Image(core.Tensor(depth))
        rgb = o3d.t.geometry.Image(core.Tensor(rgb)) if color else None
        pose = core.Tensor(camera_from_world)
        start, used = time.perf_counter(), time.process_time()
        blocks = grid.compute_unique_block_coordinates(depth, k, pose, 1000.0, MAX_DEPTH, TRUNC_VOXELS)
        if color:
            grid.integrate(blocks, depth, rgb, k, k, pose, 1000.0, MAX_DEPTH, TRUNC_VOXELS)
        else:
            grid.integrate(blocks, depth, k, pose, 1000.0, MAX_DEPTH, TRUNC_VOXELS)
        ms.append(1e3 * (time.perf_counter() - start))
        cpu.append(1e3 * (time.process_time() - used))
    start = time.perf_counter()
    mesh = grid.extract_triangle_mesh(0.5)
    return np.median(ms), np.mean(cpu), 1e3 * (time.perf_counter() - start), (
        mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy().astype(np.uint32))


def ours(binary, folder, count, color, extra):
    with tempfile.NamedTemporaryFile() as cloud, tempfile.NamedTemporaryFile() as faces:
        command = [binary, folder, "--voxel", str(VOXEL), "--trunc", str(TRUNC_VOXELS), "--max-depth", str(MAX_DEPTH),
                   "--frames", str(count), "--cloud", cloud.name, "--triangles", faces.name, "--points", str(count), *extra] + (["--color"] if color else [])
        out = subprocess.run(command, env={**os.environ, "RAYON_NUM_THREADS": THREADS}, check=True,
                             capture_output=True, text=True).stdout
        result = json.loads(out)
        return result["ms_per_frame"], result["cpu_ms_per_frame"], result["extract_ms"], (
            np.fromfile(cloud.name, "<f4").reshape(-1, 3), np.fromfile(faces.name, "<u4").reshape(-1, 3)), result


def distances(points, mesh):
    """From each point to the surface of the mesh, metres."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(*(o3d.core.Tensor(np.ascontiguousarray(part)) for part in mesh))
    return scene.compute_distance(o3d.core.Tensor(np.ascontiguousarray(points, np.float32))).numpy()


def closeness(a, b):
    """Median and mean distance (mm) from the vertices of a to the surface of b, and the share within one voxel."""
    distance = distances(a[0], b)
    return 1e3 * np.median(distance), 1e3 * np.mean(distance), np.mean(distance < VOXEL)


def views_in_support(vertices, frames):
    """For every vertex, in how many frames its pixel measured a depth within one voxel of the vertex's z."""
    views = np.zeros(len(vertices), int)
    for depth, _, camera_from_world in frames:
        x, y, z = camera_from_world[:3, :3] @ vertices.T.astype(float) + camera_from_world[:3, 3:]
        front = np.maximum(z, 1e-3)
        u, v = np.rint(FOCAL * x / front + CX), np.rint(FOCAL * y / front + CY)
        inside = (z > 1e-3) & (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
        measured = depth[v[inside].astype(int), u[inside].astype(int)] * 1e-3
        views[inside] += (measured > 0) & (measured < MAX_DEPTH) & (np.abs(measured - z[inside]) < VOXEL)
    return views


def support_lines(meshes, ours_by_setting, frames):
    """What share of each mesh is supported, and what ours covers of the supported part of theirs."""
    lines = ["| mesh | vertices | supported by a frame | by three frames | covers of VoxelBlockGrid | of its part "
             "supported by one frame | by three |", "|---|---|---|---|---|---|---|"]
    theirs = meshes["Open3D VoxelBlockGrid"][0]
    support = views_in_support(theirs, frames)
    for name, mesh in {**meshes, **ours_by_setting}.items():
        if len(mesh[0]) == 0:
            continue
        own = views_in_support(mesh[0], frames)
        covered = distances(theirs, mesh) < VOXEL
        lines.append(f"| {name} | {len(mesh[0])} | {100 * np.mean(own > 0):.1f} % | {100 * np.mean(own > 2):.1f} % "
                     f"| {100 * np.mean(covered):.1f} % | {100 * np.mean(covered[support > 0]):.1f} % "
                     f"| {100 * np.mean(covered[support > 2]):.1f} % |")
    missed = distances(theirs, meshes["vidar-fusion"]) >= VOXEL
    lines += ["", f"Of the vertices of VoxelBlockGrid that ours lacks at equal settings, "
              f"{100 * np.mean(support[missed] == 0):.0f} % are supported by no frame at all "
              f"({100 * np.mean(support[~missed] == 0):.0f} % of the others)."]
    return lines


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder")
    parser.add_argument("--binary", required=True)
    parser.add_argument("--frames", type=int, default=125)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out")
    args = parser.parse_args()
    lines = [
        f"7-Scenes redkitchen, {args.frames} frames 640×480, voxel 20 mm, truncation 4 voxels, range 6 m, "
        f"{THREADS} threads, Open3D {o3d.__version__}, {args.rounds} rounds in turns, medians.", "",
        "| what | integrate, ms/frame | ratio | processor time, ms/frame | ratio | extract mesh, ms | ratio | vertices |", "|---|---|---|---|---|---|---|---|"]
    quality, support = [], []
    for color in (False, True):
        frames = read(args.folder, args.frames, color)
        tools = {
            "vidar-fusion": lambda: ours(args.binary, args.folder, args.frames, color, ["--max-incidence", "90"]),
            "vidar-fusion, carving 4 m": lambda: ours(
                args.binary, args.folder, args.frames, color, ["--max-incidence", "90", "--carve", "4"]),
            "Open3D VoxelBlockGrid": lambda: voxel_block_grid(frames, color),
            "Open3D ScalableTSDFVolume": lambda: scalable(frames, color),
        }
        times = {name: [] for name in tools}
        meshes, details = {}, {}
        for _ in range(args.rounds):
            for name, run in tools.items():
                result = run()
                times[name].append(result[:3])
                meshes[name] = result[3]
                details[name] = result[4] if len(result) > 4 else {}
        base = np.median(times["vidar-fusion"], axis=0)
        for name in tools:
            t = np.median(times[name], axis=0)
            label = f"{name}, {'colour' if color else 'depth only'}"
            if len(meshes[name][0]) == 0:
                lines.append(f"| {label} | empty mesh: broken in this Open3D | | | | | | 0 |")
                continue
            lines.append(f"| {label} | {t[0]:.2f} | {t[0] / base[0]:.1f}× | {t[1]:.2f} | {t[1] / base[1]:.1f}× "
                         f"| {t[2]:.1f} | {t[2] / base[2]:.1f}× "
                         f"| {len(meshes[name][0])} |")
            if not color and name.startswith("Open3D"):
                there = closeness(meshes["vidar-fusion"], meshes[name])
                back = closeness(meshes[name], meshes["vidar-fusion"])
                quality.append(f"- to {name}: median {there[0]:.2f} mm, mean {there[1]:.2f} mm, {100 * there[2]:.1f} % "
                               f"within a voxel; back: median {back[0]:.2f} mm, mean {back[1]:.2f} mm, "
                               f"{100 * back[2]:.1f} % (the share of theirs that ours covers)")
        d = details["vidar-fusion"]
        quality.append(f"- vidar-fusion {'with colour' if color else 'depth only'}: volume {d['volume_mib']} MiB, peak "
                       f"with scratch {d['peak_mib']} MiB, {d['blocks']} blocks, {d['blocks_per_frame']} touched a frame; "
                       f"point fusion {d['points_ms_per_frame']:.2f} ms a frame, {d['points_cpu_ms_per_frame']:.2f} ms of "
                       "processor time")
        if not color:
            settings = [("80", "1"), ("90", "2"), ("80", "2")]
            support = support_lines(meshes, {
                f"vidar-fusion, {angle}°, {views} view(s)": ours(
                    args.binary, args.folder, args.frames, False, ["--max-incidence", angle, "--min-views", views])[3]
                for angle, views in settings}, frames)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    text = "\n".join(lines + ["", "Vertices of our mesh (depth only) to the surface of theirs, and back:", *quality, "",
                              "Support by the frames themselves (depth only):", "", *support]) + "\n"
    print(text)
    print(f"peak memory of this Python process {peak:.0f} MiB", file=sys.stderr)
    if args.out:
        with open(args.out, "w", encoding="utf-8") as file:
            file.write(text)


if __name__ == "__main__":
    main()
