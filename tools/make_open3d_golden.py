#!/usr/bin/env python3
"""Reference nearest-neighbour distances, made by Open3D.

    pip install open3d-cpu numpy && python tools/make_open3d_golden.py

Writes crates/vidar-eval/tests/data/open3d_nearest.json: for several pairs of point sets the first distances and
the sum of all. The sets come from a linear congruential generator that the Rust test repeats bit by bit.
"""
import json
import pathlib

import numpy as np
import open3d as o3d

OUT = pathlib.Path(__file__).resolve().parent.parent / "crates/vidar-eval/tests/data/open3d_nearest.json"
MASK = (1 << 64) - 1


def uniform(seed, n):
    """n numbers k/2^24 in [0, 1): exact in float32."""
    state, out = seed, np.empty(n, np.float32)
    for i in range(n):
        state = (state * 6364136223846793005 + 1442695040888963407) & MASK
        out[i] = (state >> 40) / float(1 << 24)
    return out


def points(kind, seed, n):
    u = uniform(seed, 3 * n).reshape(n, 3)
    if kind == "volume":  # a cube of 8 m
        return u * np.float32(8)
    if kind == "plane":  # a wall: one coordinate equal everywhere
        return np.c_[u[:, :1] * np.float32(8), u[:, 1:2] * np.float32(4), np.full((n, 1), 1.5, np.float32)]
    if kind == "lattice":  # many equal coordinates and duplicates: steps of 1/8 m in a box of 4 x 4 x 1/4 m
        steps = np.floor(u * np.array([32, 32, 2], np.float32))
        return (steps / np.float32(8)).astype(np.float32)
    raise ValueError(kind)


CASES = [("volume", 1, 3000, "volume", 2, 4000), ("volume", 3, 2000, "plane", 4, 5000),
         ("plane", 5, 3000, "plane", 6, 3000), ("lattice", 7, 3000, "lattice", 8, 2000),
         ("volume", 9, 2000, "lattice", 10, 6000)]


def cloud(p):
    c = o3d.geometry.PointCloud()
    c.points = o3d.utility.Vector3dVector(p.astype(np.float64))
    return c


cases = []
for qk, qs, qn, rk, rs, rn in CASES:
    d = np.asarray(cloud(points(qk, qs, qn)).compute_point_cloud_distance(cloud(points(rk, rs, rn))))
    cases.append({
        "query": {"kind": qk, "seed": qs, "count": qn}, "reference": {"kind": rk, "seed": rs, "count": rn},
        "first": [round(float(v), 10) for v in d[:150]], "sum": float(d.sum()), "max": float(d.max()),
    })
OUT.write_text(json.dumps({"open3d": o3d.__version__, "cases": cases}) + "\n")
print(OUT, OUT.stat().st_size, "bytes")
