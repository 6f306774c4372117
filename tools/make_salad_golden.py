#!/usr/bin/env python3
"""Makes crates/vidar-da3/tests/data/salad_tiny.safetensors: a tiny SALAD with random weights, an input and its descriptor.

Needs: pip install torch safetensors numpy
  python tools/make_salad_golden.py crates/vidar-da3/tests/data/salad_tiny.safetensors

Written from the papers (DINOv2: Oquab et al. 2023; SALAD: Izquierdo and Civera 2024) in plain PyTorch, float64. Keys are those of
the published checkpoint.
"""
import sys

import torch
import torch.nn.functional as F
from safetensors.torch import save_file

DIM, HEADS, DEPTH, GRID, PATCH = 64, 1, 2, 4, 14
FEATURES, CLUSTERS, GLOBAL, HIDDEN = 6, 4, 5, 16
ROWS, COLUMNS = 3, 5


def weights(generator):
    def normal(*shape, std=0.1):
        return torch.randn(*shape, generator=generator, dtype=torch.float64) * std

    w = {
        "cls_token": normal(1, 1, DIM),
        "pos_embed": normal(1, 1 + GRID * GRID, DIM),
        "patch_embed.proj.weight": normal(DIM, 3, PATCH, PATCH, std=0.05),
        "patch_embed.proj.bias": normal(DIM),
        "norm.weight": 1 + normal(DIM),
        "norm.bias": normal(DIM),
    }
    for i in range(DEPTH):
        for norm in ("norm1", "norm2"):
            w[f"blocks.{i}.{norm}.weight"] = 1 + normal(DIM)
            w[f"blocks.{i}.{norm}.bias"] = normal(DIM)
        for layer, out, inputs in (
            ("attn.qkv", 3 * DIM, DIM),
            ("attn.proj", DIM, DIM),
            ("mlp.fc1", 2 * DIM, DIM),
            ("mlp.fc2", DIM, 2 * DIM),
        ):
            w[f"blocks.{i}.{layer}.weight"] = normal(out, inputs, std=0.2)
            w[f"blocks.{i}.{layer}.bias"] = normal(out)
        for scale in ("ls1", "ls2"):
            w[f"blocks.{i}.{scale}.gamma"] = 0.7 + normal(DIM)
    salad = {"dust_bin": torch.tensor([0.6], dtype=torch.float64)}
    for part, outputs, kernel, second in (
        ("cluster_features", FEATURES, True, 3),
        ("score", CLUSTERS, True, 3),
        ("token_features", GLOBAL, False, 2),
    ):
        one = (1, 1) if kernel else ()
        salad[f"{part}.0.weight"] = normal(HIDDEN, DIM, *one, std=0.3)
        salad[f"{part}.0.bias"] = normal(HIDDEN)
        salad[f"{part}.{second}.weight"] = normal(outputs, HIDDEN, *one, std=0.3)
        salad[f"{part}.{second}.bias"] = normal(outputs)
    return w, salad


def encode(w, pixels):
    x = F.conv2d(pixels[None], w["patch_embed.proj.weight"], w["patch_embed.proj.bias"], stride=PATCH)
    x = x.flatten(2).transpose(1, 2)
    x = torch.cat([w["cls_token"], x], 1)
    grid = w["pos_embed"][:, 1:].reshape(1, GRID, GRID, DIM).permute(0, 3, 1, 2)
    factors = ((ROWS + 0.1) / GRID, (COLUMNS + 0.1) / GRID)
    grid = F.interpolate(grid, scale_factor=factors, mode="bicubic", antialias=False)
    assert grid.shape[2:] == (ROWS, COLUMNS)
    x = x + torch.cat([w["pos_embed"][:, :1], grid.flatten(2).transpose(1, 2)], 1)
    for i in range(DEPTH):
        b = {k[len(f"blocks.{i}."):]: v for k, v in w.items() if k.startswith(f"blocks.{i}.")}
        y = F.layer_norm(x, (DIM,), b["norm1.weight"], b["norm1.bias"], 1e-6)
        q, k, v = (y @ b["attn.qkv.weight"].T + b["attn.qkv.bias"]).chunk(3, -1)
        y = torch.softmax(q @ k.transpose(1, 2) / (DIM // HEADS) ** 0.5, -1) @ v
        x = x + b["ls1.gamma"] * (y @ b["attn.proj.weight"].T + b["attn.proj.bias"])
        y = F.layer_norm(x, (DIM,), b["norm2.weight"], b["norm2.bias"], 1e-6)
        y = F.gelu(y @ b["mlp.fc1.weight"].T + b["mlp.fc1.bias"])
        x = x + b["ls2.gamma"] * (y @ b["mlp.fc2.weight"].T + b["mlp.fc2.bias"])
    x = F.layer_norm(x, (DIM,), w["norm.weight"], w["norm.bias"], 1e-6)
    return x[0, 0], x[0, 1:].T


def two(salad, part, x):
    first, second = sorted(int(k.split(".")[1]) for k in salad if k.startswith(part) and k.endswith("weight"))
    for i, layer in enumerate((first, second)):
        weight = salad[f"{part}.{layer}.weight"].flatten(1)
        x = weight @ x + salad[f"{part}.{layer}.bias"][:, None]
        x = x.clamp(min=0) if i == 0 else x
    return x


def describe(salad, token, patches):
    features, scores = two(salad, "cluster_features", patches), two(salad, "score", patches)
    g = two(salad, "token_features", token[:, None])[:, 0]
    m, n = CLUSTERS, patches.shape[1]
    matrix = torch.cat([scores, salad["dust_bin"].expand(1, n)], 0)
    c = -torch.log(torch.tensor(float(m + n), dtype=torch.float64))
    log_a = torch.full((m + 1,), float(c), dtype=torch.float64)
    log_a[m] += torch.log(torch.tensor(float(n - m), dtype=torch.float64))
    u, v = torch.zeros(m + 1, dtype=torch.float64), torch.zeros(n, dtype=torch.float64)
    for _ in range(3):
        u = log_a - torch.logsumexp(matrix + v[None], 1)
        v = c - torch.logsumexp(matrix + u[:, None], 0)
    p = torch.exp(matrix + u[:, None] + v[None] - c)[:m]
    gathered = F.normalize(features @ p.T, dim=0)
    return F.normalize(torch.cat([F.normalize(g, dim=0), gathered.flatten()]), dim=0)


def main(target):
    generator = torch.Generator().manual_seed(11)
    w, salad = weights(generator)
    # The stored numbers are the truth, not those before rounding.
    w = {k: v.float().double() for k, v in w.items()}
    salad = {k: v.float().double() for k, v in salad.items()}
    pixels = torch.randn(3, ROWS * PATCH, COLUMNS * PATCH, generator=generator).double()
    descriptor = describe(salad, *encode(w, pixels))
    tensors = {f"backbone.model.{k}": v for k, v in w.items()}
    tensors |= {f"aggregator.{k}": v for k, v in salad.items()}
    tensors |= {"golden.pixels": pixels, "golden.descriptor": descriptor}
    save_file({k: v.float().contiguous() for k, v in tensors.items()}, target)


if __name__ == "__main__":
    main(sys.argv[1])
