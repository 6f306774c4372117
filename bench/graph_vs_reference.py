#!/usr/bin/env python3
"""Times pose graphs of vidar-align and DA3-Streaming's scheme, in turns, in one run.

Needs: pip install numpy scipy safetensors
  cargo build --release -p vidar-align --example solve_graphs
  python bench/graph_vs_reference.py --binary target/release/examples/solve_graphs

The reference is what the official code does on a CPU, written from its behaviour: Levenberg-Marquardt over the chunks' Sim(3)
logarithms, damped with the diagonal, edges and their Jacobians by truncated series, J^T J by a sparse product, SciPy's direct
solver, at most 30 iterations, rejected ones counted. The official code builds the Jacobians with PyTorch; here all edges go through
numpy at once, which is quicker. Three measurements: the same graph of 25 chunks and 16 loops on both sides; the same with 525
nodes, as many as the coupled graph has; and the coupled graph itself (500 keyframes, 25 chunks), which the reference lacks.
Time is processor time of all threads, so that a busy machine matters less, and the best round's wall time. The two results of one
graph are compared.
"""

import argparse
import json
import resource
import statistics
import subprocess
import tempfile
import time

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from safetensors.numpy import save_file


def hat(v):
    out = np.zeros(v.shape[:-1] + (3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def rotation_and_w(phi, sigma):
    """exp of a turn, and the matrix that carries tau to the translation: the integral of e^(sigma u) exp(u phi) over u."""
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    s = sigma[..., None, None]
    k = hat(phi)
    k2 = k @ k
    small, flat = angle < 1e-6, np.abs(s) < 1e-6
    a, z = np.where(small, 1, angle), np.where(flat, 1, s)
    r = (
        np.eye(3)
        + np.where(small, 1 - angle**2 / 6, np.sin(a) / a) * k
        + np.where(small, 0.5, (1 - np.cos(a)) / a**2) * k2
    )
    c = np.where(flat, 1 + s / 2, (np.exp(z) - 1) / z)
    grown, below = np.exp(s), s**2 + a**2  # at rest a is 1
    sine = (grown * (s * np.sin(a) - a * np.cos(a)) + a) / below
    cosine = (grown * (s * np.cos(a) + a * np.sin(a)) - s) / below
    first = np.where(flat, 0.5, (1 + (z - 1) * np.exp(z)) / z**2)
    second = np.where(flat, 1 / 6, (np.exp(z) * (z**2 - 2 * z + 2) - 2) / (2 * z**3))
    return r, c * np.eye(3) + np.where(small, first, sine / a) * k + np.where(small, second, (c - cosine) / a**2) * k2


def exp(v):
    r, w = rotation_and_w(v[..., 3:6], v[..., 6])
    return np.exp(v[..., 6]), r, np.einsum("...ij,...j->...i", w, v[..., :3])


def log(x):
    s, r, t = x
    skew = np.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1) / 2
    sine, cosine = np.linalg.norm(skew, axis=-1), (np.trace(r, axis1=-2, axis2=-1) - 1) / 2
    angle = np.arctan2(sine, cosine)
    phi = skew * np.where(sine < 1e-9, 1, angle / np.where(sine < 1e-9, 1, sine))[..., None]
    sigma = np.log(s)
    _, w = rotation_and_w(phi, sigma)
    return np.concatenate([np.linalg.solve(w, t[..., None])[..., 0], phi, sigma[..., None]], -1)


def times(a, b):
    turned = np.einsum("...ij,...j->...i", a[1], b[2])
    return a[0] * b[0], a[1] @ b[1], a[0][..., None] * turned + a[2]


def inverse(x):
    back = np.swapaxes(x[1], -1, -2)
    return 1 / x[0], back, -np.einsum("...ij,...j->...i", back, x[2]) / x[0][..., None]


def adjoint(x):
    s, r, t = x
    out = np.zeros(s.shape + (7, 7))
    out[..., :3, :3], out[..., :3, 3:6], out[..., :3, 6] = s[..., None, None] * r, hat(t) @ r, -t
    out[..., 3:6, 3:6], out[..., 6, 6] = r, 1
    return out


def small_adjoint(v):
    out = np.zeros(v.shape[:-1] + (7, 7))
    out[..., :3, :3] = hat(v[..., 3:6]) + v[..., 6, None, None] * np.eye(3)
    out[..., :3, 3:6], out[..., :3, 6], out[..., 3:6, 3:6] = hat(v[..., :3]), -v[..., :3], hat(v[..., 3:6])
    return out


def left_jacobian(v):
    x = small_adjoint(v)
    x2 = x @ x
    x4 = x2 @ x2
    return np.eye(7) + x / 2 + x2 / 6 + x2 @ x / 24 + x4 / 120 + x4 @ x / 720


def left_jacobian_inverse(v):
    x = small_adjoint(v)
    x2 = x @ x
    return np.eye(7) - x / 2 + x2 / 12 - x2 @ x2 / 720


def pick(x, index):
    return tuple(part[index] for part in x)


def reference(chain, loops):
    """DA3-Streaming's pose graph: relatives after it, iterations, the last cost."""
    n = len(chain[0])
    placed = [(np.ones(()), np.eye(3), np.zeros(3))]
    for k in range(n):
        placed.append(times(placed[-1], pick(chain, k)))
    g = log(inverse(tuple(np.stack(part) for part in zip(*placed))))
    a, b, closing = loops
    i, j = np.concatenate([np.arange(1, n + 1), a]), np.concatenate([np.arange(n), b])
    edges = tuple(np.concatenate(pair) for pair in zip(chain, closing))
    rows = np.arange(7 * len(i)).reshape(-1, 7, 1)
    columns = lambda node: 7 * node[:, None, None] + np.arange(7)[None, None, :]
    row = np.concatenate([np.broadcast_to(rows, (len(i), 7, 7)).ravel()] * 2)
    column = np.concatenate([np.broadcast_to(columns(node), (len(i), 7, 7)).ravel() for node in (i, j)])
    shape = (7 * len(i), 7 * (n + 1))

    def errors(g):
        nodes = exp(g)
        return times(times(edges, pick(nodes, i)), inverse(pick(nodes, j)))

    damping, costs = 1e-6, []
    error = errors(g)
    r = log(error)
    for iteration in range(30):
        costs.append(np.mean(r**2))
        left, jacobian = left_jacobian_inverse(r), left_jacobian(g)
        to_i, to_j = left @ adjoint(edges) @ jacobian[i], -left @ adjoint(error) @ jacobian[j]
        big = scipy.sparse.csc_matrix((np.concatenate([to_i.ravel(), to_j.ravel()]), (row, column)), shape)
        normal = (big.T @ big).tocsc()
        normal = normal + scipy.sparse.diags(damping * normal.diagonal(), format="csc")
        tried = g + scipy.sparse.linalg.spsolve(normal, -big.T @ r.ravel()).reshape(-1, 7)
        tried_error = errors(tried)
        tried_r = log(tried_error)
        if np.mean(tried_r**2) < costs[-1]:
            g, error, r = tried, tried_error, tried_r
            damping /= 2
        else:
            damping *= 2
        if costs[-1] < 1e-5 and iteration >= 4 and costs[-5] / costs[-1] < 1.5:
            break
    after = inverse(exp(g))
    return times(inverse(pick(after, slice(0, n))), pick(after, slice(1, n + 1))), iteration + 1, np.mean(r**2)


def ring(nodes, laps, closings, rng):
    """Laps of a circle whose steps drift, and loops that do not."""
    turn = 2 * np.pi * laps / nodes
    v = np.tile([0.6, 0.05, 0.0, 0.0, 0.0, turn, 0.0], (nodes - 1, 1))
    true = exp(v)
    placed = [(np.ones(()), np.eye(3), np.zeros(3))]
    for k in range(nodes - 1):
        placed.append(times(placed[-1], pick(true, k)))
    placed = tuple(np.stack(part) for part in zip(*placed))
    # The drift of a lap is the same whatever the number of its steps.
    noise = rng.normal(size=v.shape) * np.array([0.2, 0.2, 0.2, 0.06, 0.06, 0.06, 0.1]) / np.sqrt(nodes)
    chain = times(true, exp(noise))
    lap = nodes // laps
    a = np.linspace(lap, nodes - 1, closings).astype(int)
    b = a - lap
    found = times(times(inverse(pick(placed, b)), pick(placed, a)), exp(0.01 * rng.normal(size=(closings, 7))))
    return chain, (a, b, found)


def flat(x):
    return np.concatenate([x[0][:, None], x[1].reshape(-1, 9), x[2]], 1)


def run(binary, few, many, *what):
    """Processor and wall seconds of one solution, and what the program printed: two runs, whose difference has no start in it."""
    used = []
    for rounds in (few, many):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        out = subprocess.run([binary, *what, str(rounds)], check=True, capture_output=True, text=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        used.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    found = json.loads(out.stdout)
    return (used[1] - used[0]) / (many - few), min(found["seconds"]), found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--binary", required=True)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    rng = np.random.default_rng(3)
    print("| graph | tool | iterations | processor time per iteration [ms] | wall, best [ms] | cost at the end |")
    print("|---|---|---|---|---|---|")
    for nodes in (25, 525):
        chain, loops = ring(nodes, 3, 16, rng)
        theirs, ours, coupled = [], [], []
        with tempfile.NamedTemporaryFile(suffix=".safetensors") as file:
            loop_rows = np.concatenate([loops[0][:, None], loops[1][:, None], flat(loops[2])], 1)
            save_file({"chain": flat(chain), "loops": loop_rows}, file.name)
            reference(chain, loops)  # warms up
            for _ in range(args.rounds):
                cpu, wall = time.process_time(), time.perf_counter()
                for _ in range(5):
                    answer, count, cost = reference(chain, loops)
                theirs.append(((time.process_time() - cpu) / 5, (time.perf_counter() - wall) / 5))
                *spent, found = run(args.binary, 1, 41, "chain", file.name)
                ours.append(spent)
                *spent, own = run(args.binary, 1, 6, "coupled")
                coupled.append(spent)
        name = f"{nodes} chunks, 16 loops"
        for graph, tool, spent, iterations, end in (
            (name, "DA3-Streaming's scheme, numpy and SciPy", theirs, count, f"{cost:.3e}"),
            (name, "vidar-align, the same scheme", ours, found["iterations"], f"{found['cost']:.3e}"),
            ("coupled, 500 keyframes and 25 chunks", "vidar-align", coupled, own["iterations"], "–"),
        ):
            cpu, wall = (
                1e3 / iterations * value for value in (statistics.median(c for c, _ in spent), min(w for _, w in spent))
            )
            print(f"| {graph} | {tool} | {iterations} | {cpu:.2f} | {wall:.2f} | {end} |")
        apart = np.abs(flat(answer) - np.array(found["relatives"])).max()
        print(f"{nodes} chunks: the two answers differ by {apart:.1e} at most", flush=True)


if __name__ == "__main__":
    main()
