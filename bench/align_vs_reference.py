#!/usr/bin/env python3
"""Aligns one overlap (60 frames of 504 x 322) with vidar-align and with DA3-Streaming's numpy and numba paths, in turns.

Needs: pip install numpy safetensors numba
  cargo build --release -p vidar-align --example align_overlap
  python bench/align_vs_reference.py --binary target/release/examples/align_overlap

The reference is what the official code does on a CPU, without and with numba, written from its behaviour: point maps of all pixels,
a confidence threshold of a tenth of the smaller median, weights sqrt(c1 c2), five reweightings with Huber's loss at 0.1,
float32 throughout. Both get the same depth, confidence and poses in memory; reading files is not timed. The output is
processor time of all threads, which a busy machine affects little, and the best wall time. The scene is a
wavy wall seen by a turning camera; the second chunk has a gauge of its own, smooth errors that neighbouring pixels share,
and a share of pixels that are grossly off to one side (as behind edges and on glass).
"""
import argparse
import json
import resource
import statistics
import subprocess
import tempfile
import time

import numpy as np
from numba import njit, prange
from safetensors.numpy import save_file

FRAMES, WIDTH, HEIGHT = 60, 504, 322
K = np.array([[420.0, 0, 251.5], [0, 420.0, 160.5], [0, 0, 1]], np.float32)
SCALE = 1.37


def rotation(v):
    angle = np.linalg.norm(v)
    if angle < 1e-12:
        return np.eye(3)
    k = v / angle
    k = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def smooth(rng, std):
    """Errors shared by patches of about 40 pixels."""
    coarse = rng.normal(size=(HEIGHT // 40 + 2, WIDTH // 40 + 2))
    y = np.linspace(0, coarse.shape[0] - 1.001, HEIGHT)
    x = np.linspace(0, coarse.shape[1] - 1.001, WIDTH)
    y0, x0 = y.astype(int), x.astype(int)
    fy, fx = (y - y0)[:, None], (x - x0)[None]
    at = lambda dy, dx: coarse[np.ix_(y0 + dy, x0 + dx)]
    top = at(0, 0) * (1 - fx) + at(0, 1) * fx
    return std * (top * (1 - fy) + (at(1, 0) * (1 - fx) + at(1, 1) * fx) * fy)


def scene(outliers):
    rng = np.random.default_rng(7)
    gauge = rotation(np.array([0.2, -0.7, 0.4]))
    shift = np.array([1.0, -2.0, 0.5])
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    d1, d2, c1, c2 = (np.empty((FRAMES, HEIGHT, WIDTH), np.float32) for _ in range(4))
    t1, t2 = np.empty((FRAMES, 4, 4), np.float32), np.empty((FRAMES, 4, 4), np.float32)
    for i in range(FRAMES):
        true = 3.0 + 0.6 * (np.sin(0.02 * x + 0.1 * i) + np.cos(0.03 * y))
        gross = np.zeros((HEIGHT, WIDTH), bool)
        top = int(outliers * HEIGHT)
        gross[:top] = True
        d1[i] = true * np.exp(smooth(rng, 0.006))
        d2[i] = true * np.exp(smooth(rng, 0.006)) / SCALE * np.where(gross, 1.35, 1.0)
        c1[i] = 0.7 + 0.2 * np.sin(0.05 * x)
        c2[i] = 0.7 + 0.2 * np.cos(0.05 * y)
        pose = np.eye(4)
        pose[:3, :3] = rotation(np.array([0.0, 0.01 * i, 0.0]))
        pose[:3, 3] = [0.05 * i, 0, 0.02 * i]
        t1[i] = pose
        # chunk 1 = SCALE * gauge * chunk 2 + shift
        second = np.eye(4)
        second[:3, :3] = gauge.T @ pose[:3, :3]
        second[:3, 3] = gauge.T @ (pose[:3, 3] - shift) / SCALE
        t2[i] = second
    return dict(depth1=d1, depth2=d2, conf1=c1, conf2=c2, chunk_from_camera1=t1, chunk_from_camera2=t2, K=K), (SCALE, gauge, shift)


@njit(parallel=True, cache=False)
def points_numba(depth, pose, rays):
    frames, height, width = depth.shape
    out = np.empty((frames, height, width, 3), np.float32)
    for i in prange(frames):
        r, t = pose[i, :3, :3], pose[i, :3, 3]
        for v in range(height):
            for u in range(width):
                d = depth[i, v, u]
                x, y, z = rays[v, u, 0] * d, rays[v, u, 1] * d, rays[v, u, 2] * d
                for k in range(3):
                    out[i, v, u, k] = r[k, 0] * x + r[k, 1] * y + r[k, 2] * z + t[k]
    return out


@njit(parallel=True, cache=False)
def moments(x, y, w):
    """Sum of weights, weighted means, spreads and cross covariance, in two passes over the points."""
    n = x.shape[0]
    total = 0.0
    x0 = x1 = x2 = y0 = y1 = y2 = 0.0
    for i in prange(n):
        total += w[i]
        x0 += w[i] * x[i, 0]
        x1 += w[i] * x[i, 1]
        x2 += w[i] * x[i, 2]
        y0 += w[i] * y[i, 0]
        y1 += w[i] * y[i, 1]
        y2 += w[i] * y[i, 2]
    mx = np.array([x0, x1, x2]) / total
    my = np.array([y0, y1, y2]) / total
    sx = sy = 0.0
    h00 = h01 = h02 = h10 = h11 = h12 = h20 = h21 = h22 = 0.0
    for i in prange(n):
        a0, a1, a2 = x[i, 0] - mx[0], x[i, 1] - mx[1], x[i, 2] - mx[2]
        b0, b1, b2 = y[i, 0] - my[0], y[i, 1] - my[1], y[i, 2] - my[2]
        sx += w[i] * (a0 * a0 + a1 * a1 + a2 * a2)
        sy += w[i] * (b0 * b0 + b1 * b1 + b2 * b2)
        h00 += w[i] * a0 * b0
        h01 += w[i] * a0 * b1
        h02 += w[i] * a0 * b2
        h10 += w[i] * a1 * b0
        h11 += w[i] * a1 * b1
        h12 += w[i] * a1 * b2
        h20 += w[i] * a2 * b0
        h21 += w[i] * a2 * b1
        h22 += w[i] * a2 * b2
    h = np.array([[h00, h01, h02], [h10, h11, h12], [h20, h21, h22]])
    return total, mx, my, sx, sy, h


def closed_numba(x, y, w):
    _, mx, my, sx, sy, h = moments(x, y, w)
    s = np.sqrt(sy / sx)
    u, _, vt = np.linalg.svd(s * h)
    r = vt.T @ u.T
    if np.linalg.det(r) < 0:
        vt[2] *= -1
        r = vt.T @ u.T
    return s, r, my - s * r @ mx


@njit(parallel=True, cache=False)
def reweighted(x, y, w, s, r, t):
    """Huber weights and the sum of losses."""
    n = x.shape[0]
    out = np.empty(n, np.float32)
    cost = 0.0
    for i in prange(n):
        square = 0.0
        for k in range(3):
            d = y[i, k] - (s * (r[k, 0] * x[i, 0] + r[k, 1] * x[i, 1] + r[k, 2] * x[i, 2]) + t[k])
            square += d * d
        size = np.sqrt(square)
        out[i] = w[i] * (0.1 / size if size > 0.1 else 1.0)
        cost += w[i] * (square / 2 if size <= 0.1 else 0.1 * (size - 0.05))
    return out, cost


def points(depth, pose):
    y, x = np.meshgrid(np.arange(HEIGHT, dtype=np.float32), np.arange(WIDTH, dtype=np.float32), indexing="ij")
    pixels = np.stack([x, y, np.ones_like(x)], -1)
    rays = pixels @ np.linalg.inv(K).T
    out = np.empty(depth.shape + (3,), np.float32)
    for i in range(len(depth)):
        camera = rays * depth[i][..., None]
        out[i] = camera @ pose[i, :3, :3].T + pose[i, :3, 3]
    return out


def closed(x, y, w):
    w = w / w.sum()
    mx, my = w @ x, w @ y
    a, b = x - mx, y - my
    s = np.sqrt((w * (b**2).sum(1)).sum() / (w * (a**2).sum(1)).sum())
    u, _, vt = np.linalg.svd((w[:, None] * s * a).T @ b)
    r = vt.T @ u.T
    if np.linalg.det(r) < 0:
        vt[2] *= -1
        r = vt.T @ u.T
    return s, r, my - s * r @ mx


def rays_of_pixels():
    y, x = np.meshgrid(np.arange(HEIGHT, dtype=np.float32), np.arange(WIDTH, dtype=np.float32), indexing="ij")
    return (np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T).astype(np.float32)


def reference(data, numba=False):
    """DA3-Streaming on a CPU, numpy or numba flavour."""
    if numba:
        rays = rays_of_pixels()
        p1 = points_numba(data["depth1"], data["chunk_from_camera1"], rays)
        p2 = points_numba(data["depth2"], data["chunk_from_camera2"], rays)
    else:
        p1, p2 = points(data["depth1"], data["chunk_from_camera1"]), points(data["depth2"], data["chunk_from_camera2"])
    odds = lambda c: c / (1 - c)
    c1, c2 = odds(data["conf1"]), odds(data["conf2"])
    tau = 0.1 * min(np.median(c1), np.median(c2))
    keep = (c1 > tau) & (c2 > tau)
    y, x, w = p1[keep], p2[keep], np.sqrt(c1[keep] * c2[keep])
    fit = closed_numba if numba else closed
    s, r, t = fit(x, y, w)
    before = np.inf
    for _ in range(5):
        if numba:
            weights, cost = reweighted(x, y, w, s, r, t)
            s2, r2, t2 = fit(x, y, weights)
            moved = abs(s2 - s) + np.linalg.norm(t2 - t)
            angle = np.arccos(np.clip((np.trace(r2 @ r.T) - 1) / 2, -1, 1))
            if (moved < 1e-9 and angle < np.radians(0.1)) or abs(before - cost) < 1e-9 * before:
                break
            s, r, t, before = s2, r2, t2, cost
            continue
        size = np.linalg.norm(y - (s * x @ r.T + t), axis=1)
        huber = np.where(size > 0.1, 0.1 / np.maximum(size, 1e-12), 1)
        s2, r2, t2 = closed(x, y, w * huber / ((w * huber).sum() + 1e-12))
        cost = (w * np.where(size <= 0.1, size * size / 2, 0.1 * (size - 0.05))).sum()
        moved = abs(s2 - s) + np.linalg.norm(t2 - t)
        angle = np.arccos(np.clip((np.trace(r2 @ r.T) - 1) / 2, -1, 1))
        if (moved < 1e-9 and angle < np.radians(0.1)) or abs(before - cost) < 1e-9 * before:
            break
        s, r, t, before = s2, r2, t2, cost
    return s, r, t


def error(found, truth):
    (s, r, t), (ts, tr, tt) = found, truth
    angle = np.degrees(np.arccos(np.clip((np.trace(r @ tr.T) - 1) / 2, -1, 1)))
    return 100 * (s / ts - 1), angle, np.linalg.norm(t - tt)


def run(binary, path, rounds):
    """Processor time of the whole process, and what it printed."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    out = subprocess.run([binary, path, str(rounds)], check=True, capture_output=True, text=True)
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before, json.loads(out.stdout)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--binary", required=True)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    print("| outliers | tool | processor time [s] | best wall time [s] | scale error [%] | rotation error [deg] | shift error | stated scale sigma [%] |")
    print("|---|---|---|---|---|---|---|---|")
    for outliers in (0.0, 0.2):
        data, truth = scene(outliers)
        with tempfile.NamedTemporaryFile(suffix=".safetensors") as file:
            save_file(data, file.name)
            theirs, compiled, ours, answer, found = [], [], [], None, None
            reference(data, numba=True)  # compiles
            for _ in range(args.rounds):
                wall, cpu = time.perf_counter(), time.process_time()
                answer = reference(data)
                theirs.append((time.process_time() - cpu, time.perf_counter() - wall))
                wall, cpu = time.perf_counter(), time.process_time()
                same = reference(data, numba=True)
                compiled.append((time.process_time() - cpu, time.perf_counter() - wall))
                few, _ = run(args.binary, file.name, 1)
                many, found = run(args.binary, file.name, 11)
                ours.append(((many - few) / 10, min(found["seconds"])))
        mine = (found["scale"], np.array(found["rotation"]).reshape(3, 3), np.array(found["translation"]))
        for name, times, result, sigma in (
            ("DA3-Streaming (numpy)", theirs, answer, float("nan")),
            ("DA3-Streaming (numba)", compiled, same, float("nan")),
            ("vidar-align", ours, mine, 100 * found["log_scale_std"]),
        ):
            s, r, t = error(result, truth)
            cpu, wall = statistics.median(c for c, _ in times), min(w for _, w in times)
            print(f"| {outliers:.0%} | {name} | {cpu:.3f} | {wall:.3f} | {s:+.3f} | {r:.3f} | {t:.4f} | {sigma:.3f} |")


if __name__ == "__main__":
    main()
