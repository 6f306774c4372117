#!/usr/bin/env python3
"""Nearest-neighbour distances between two surface clouds: vidar-eval, SciPy and Open3D, in turns.

  pip install open3d-cpu numpy scipy
  cargo build --release -p vidar-eval --example nearest_files
  python bench/nn_vs_scipy.py --binary target/release/examples/nearest_files --counts 1000000 10000000

Each tool builds its tree over the reference and asks the distance of every point of the estimate, unordered, on two
threads; making its input (files, f64 arrays) is not timed. Rounds alternate; medians are given, by the wall clock and
in processor time (the sum over threads, which a busy machine disturbs less). Distances of all are compared.
"""
import argparse
import json
import os
import subprocess
import tempfile
import time

THREADS = 2
os.environ["OMP_NUM_THREADS"] = str(THREADS)
os.environ["OMP_WAIT_POLICY"] = "passive"

import numpy as np  # noqa: E402
import open3d as o3d  # noqa: E402
import scipy  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402


def room(count, seed, noise):
    """Points on the six walls of 10 m x 8 m x 3 m and on 40 boxes, in random order, with noise across."""
    rng = np.random.default_rng(seed)
    scene = np.random.default_rng(0)
    boxes = [(np.array([-5.0, -4.0, 0.0]), np.array([10.0, 8.0, 3.0]))]
    for _ in range(40):
        size = scene.uniform(0.2, 1.5, 3)
        boxes.append((np.array([*scene.uniform([-5, -4], [3.5, 2.5]), 0.0]), size))
    sheets = []
    for origin, size in boxes:
        for axis in range(3):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            for side in (0.0, size[axis]):
                sheets.append((origin, size, axis, a, b, side, size[a] * size[b]))
    area = np.array([s[-1] for s in sheets])
    shares = rng.multinomial(count, area / area.sum())
    parts = []
    for (origin, size, axis, a, b, side, _), n in zip(sheets, shares):
        p = np.empty((n, 3))
        p[:, a], p[:, b] = rng.uniform(0, size[a], n), rng.uniform(0, size[b], n)
        p[:, axis] = side + rng.normal(0, noise, n)
        parts.append(p + origin)
    return rng.permutation(np.concatenate(parts)).astype(np.float32)


def timed(work):
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, time.perf_counter() - wall, time.process_time() - cpu


def scipy_distances(query, reference, **kwargs):
    return lambda: cKDTree(reference, **kwargs).query(query, workers=THREADS)[0]


def open3d_distances(query, reference):
    clouds = []
    for points in (query, reference):
        cloud = o3d.geometry.PointCloud()
        cloud.points = o3d.utility.Vector3dVector(points)
        clouds.append(cloud)
    return lambda: np.asarray(clouds[0].compute_point_cloud_distance(clouds[1]))


def compare(binary, count, rounds, folder, noises):
    paths = [os.path.join(folder, f"{name}.f32") for name in ("query", "reference", "distances")]
    clouds = [room(count, 1, noises[0]), room(count, 2, noises[1])]
    for path, cloud in zip(paths, clouds):
        cloud.tofile(path)
    query, reference = (c.astype(np.float64) for c in clouds)
    others = {
        "SciPy cKDTree, defaults": scipy_distances(query, reference),
        "SciPy cKDTree, unbalanced, not compact": scipy_distances(
            query, reference, balanced_tree=False, compact_nodes=False),
        "Open3D compute_point_cloud_distance": open3d_distances(query, reference),
    }
    walls = {"vidar-eval": [], **{name: [] for name in others}}
    cpus = {name: [] for name in walls}
    worst = {name: 0.0 for name in others}
    builds, peak, given = [], 0.0, 0.0
    for _ in range(rounds):
        said = subprocess.run([binary, *paths, str(THREADS), "1"], check=True, capture_output=True, text=True)
        ours = json.loads(said.stdout)
        builds += ours["build"]
        walls["vidar-eval"].append(ours["build"][0] + ours["query"][0])
        cpus["vidar-eval"].append(ours["processor"][0])
        peak, given = max(peak, ours["peak_mib"]), ours["points_mib"]
        mine = np.fromfile(paths[2], np.float32).astype(np.float64)
        for name, work in others.items():
            distances, wall, cpu = timed(work)
            walls[name].append(wall)
            cpus[name].append(cpu)
            worst[name] = max(worst[name], float(np.abs(distances - mine).max()))
    base, base_cpu = np.median(walls["vidar-eval"]), np.median(cpus["vidar-eval"])
    lines = [
        f"{count:,} points to {count:,}, noise {noises[0] * 1e3:g} mm against {noises[1] * 1e3:g} mm, "
        f"{rounds} round(s). vidar-eval: {np.median(builds):.2f} s of the time is the build; peak memory "
        f"{peak:.0f} MiB, of which {given:.0f} MiB were reached by reading both files.",
        "",
        "| what | wall, s | ratio | processor time, s | ratio | largest difference, m |",
        "|---|---|---|---|---|---|",
    ]
    for name in walls:
        wall, cpu = np.median(walls[name]), np.median(cpus[name])
        difference = f"{worst[name]:.1e}" if name in worst else "–"
        lines.append(f"| {name} | {wall:.2f} | {wall / base:.1f}× | {cpu:.2f} | {cpu / base_cpu:.1f}× | {difference} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--binary", required=True)
    parser.add_argument("--counts", type=int, nargs="+", default=[1_000_000, 10_000_000])
    parser.add_argument("--rounds", type=int, nargs="+", default=[5, 1], help="for each count")
    parser.add_argument("--noise-mm", type=float, nargs=2, default=[15.0, 3.0], help="of estimate and reference")
    args = parser.parse_args()
    print(f"SciPy {scipy.__version__}, Open3D {o3d.__version__}, {THREADS} threads.\n")
    with tempfile.TemporaryDirectory() as folder:
        for count, rounds in zip(args.counts, args.rounds):
            print(compare(args.binary, count, rounds, folder, [n * 1e-3 for n in args.noise_mm]) + "\n", flush=True)
