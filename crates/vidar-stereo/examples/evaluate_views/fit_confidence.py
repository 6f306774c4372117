#!/usr/bin/env python3
"""Fits the weights of vidar-stereo's confidence to samples that `evaluate_views --csv` wrote.

    fit_confidence.py fit:1:roomA.csv fit:1:hololensA.csv test:1:redkitchen.csv ...

Each set has a part (fit or test), a weight and a file; the weight counts for the whole set. Maximum likelihood of
p = bound(pose_error) * logistic(features), see confidence.rs. Needs numpy and scipy.

fit_confidence.sh makes the samples of the weights in confidence.rs and calls this.
"""
import sys
import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, ndtr

TOLERANCE, HALF_RESIDUAL_PX = 0.03, 0.5
NAMES = ["constant", "share", "agreeing", "margin", "cost", "curvature", "resolution"]


def load(path):
    rows = np.genfromtxt(path, delimiter=",", names=True)
    rows = rows[(rows["agreeing"] > 0) & (rows["edge"] == 0) & np.isfinite(rows["error"])]
    agreeing, pixels = rows["agreeing"], rows["resolution_px"]
    features = np.stack([
        np.ones(len(rows)),
        agreeing / np.maximum(rows["compared"], 1),
        agreeing / (agreeing + 1),
        np.log(np.maximum(rows["margin"], 0) + 0.01) + 3,
        rows["cost"],
        np.log(np.maximum(rows["curvature"], 0) * pixels**2 + 0.003),
        np.log(pixels + 0.01),
    ], 1)
    residual = np.maximum(rows["residual_px"], 0.02)
    pose_error = rows["shift_px"] * residual / np.hypot(residual, HALF_RESIDUAL_PX)
    return features, pose_error, pixels, (np.abs(rows["error"]) < TOLERANCE).astype(float)


def bound(log_k, pose_error, pixels):
    sigma = np.maximum(np.hypot(np.exp(log_k[0]) / pixels, np.exp(log_k[1])) * pose_error, 1e-4)
    return np.clip(2 * ndtr(1 / sigma) - 1, 1e-4, 1 - 1e-6)


def fit(sets):
    # Every other pixel: half the time at nearly the same result.
    sets = [(w, [values[::2] for values in s]) for w, s in sets]
    x, pose_error, pixels, y = (np.concatenate(parts) for parts in zip(*[s for _, s in sets]))
    weight = np.concatenate([np.full(len(s[3]), w / len(s[3])) for w, s in sets])
    weight /= weight.sum()

    def loss(parameters):
        w, log_k = parameters[:-2], parameters[-2:]
        c, s = bound(log_k, pose_error, pixels), expit(x @ w)
        p = np.clip(c * s, 1e-6, 1 - 1e-6)
        value = -(weight * (y * np.log(p) + (1 - y) * np.log(1 - p))).sum() + 1e-4 * (w[1:] ** 2).sum()
        by_p = -weight * (y / p - (1 - y) / (1 - p))
        by_w = x.T @ (by_p * c * s * (1 - s))
        by_w[1:] += 2e-4 * w[1:]
        by_k = [(by_p * s * (bound(log_k + 1e-3 * np.eye(2)[i], pose_error, pixels) - c)).sum() / 1e-3 for i in (0, 1)]
        return value, np.concatenate([by_w, by_k])

    start = np.concatenate([np.zeros(x.shape[1]), [0.0, -1.0]])
    return minimize(loss, start, jac=True, method="L-BFGS-B", options=dict(maxiter=200)).x


def main():
    sets = []
    for argument in sys.argv[1:]:
        part, weight, path = argument.split(":", 2)
        sets.append((part, float(weight), path, load(path)))
    found = fit([(w, s) for part, w, _, s in sets if part == "fit"])
    print("weights", dict(zip(NAMES, found[:-2].round(3))))
    print("shift per pose error %.3f, scale per pose error %.3f" % tuple(np.exp(found[-2:])))
    for part, _, path, (x, pose_error, pixels, y) in sets:
        p = bound(found[-2:], pose_error, pixels) * expit(x @ found[:-2])
        bins = np.minimum((10 * p).astype(int), 9)
        gap = sum(abs(p[bins == b].sum() - y[bins == b].sum()) for b in range(10)) / len(p)
        print("%-4s %s: %d pixels, predicted %.3f, observed %.3f, gap %.3f" % (part, path, len(p), p.mean(), y.mean(), gap))


if __name__ == "__main__":
    main()
