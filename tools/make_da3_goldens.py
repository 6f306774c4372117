#!/usr/bin/env python3
"""Makes the small reference files of crates/vidar-da3/tests/data: Depth Anything 3 in float64 numpy, on tiny networks.

    python3 tools/make_da3_goldens.py crates/vidar-da3/tests/data

Needs numpy only. It shares no code with the Rust side: convolutions are sums of shifted products, attention is the full
matrix, position and ray maths are written out again. Weights and pictures are synthetic (weights/synthetic.rs
has the same formula), so the files hold inputs, intermediate results and outputs only.
"""
import json
import math
import struct
import sys
from pathlib import Path

import numpy as np

MASK = (1 << 64) - 1
erf = np.vectorize(math.erf)

# ---------------------------------------------------------------- weights and pictures by rule


def fnv1a64(name):
    value = 0xCBF29CE484222325
    for byte in name.encode():
        value = ((value ^ byte) * 0x100000001B3) & MASK
    return value


def splitmix64(x):
    with np.errstate(over="ignore"):
        x = x + np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return x ^ (x >> np.uint64(31))


def offset_scale(name, shape):
    leaf = name.rsplit(".", 1)[-1]
    matrix = lambda fan, gain=1.0: np.float32(gain * np.sqrt(np.float64(3.0) / np.float64(fan)))
    if leaf == "gamma":
        return np.float32(0.5), np.float32(0.1)
    if leaf in ("cls_token", "camera_token"):
        return np.float32(0), np.float32(1)
    if leaf == "pos_embed":
        return np.float32(0), np.float32(0.5)
    if name.endswith("cam_dec.fc_fov.0.bias"):
        return np.float32(1), np.float32(0.02)
    gains = {
        "cam_dec.fc_fov.0.weight": 0.125,
        "scratch.output_conv2.2.weight": 0.25,
        "scratch.output_conv2_aux.3.5.weight": 0.5,
        "scratch.sky_output_conv2.2.weight": 0.25,
    }
    for ending, gain in gains.items():
        if name.endswith(ending):
            return np.float32(0), matrix(shape[1], gain)
    if len(shape) == 1:
        return (np.float32(1), np.float32(0.1)) if leaf == "weight" else (np.float32(0), np.float32(0.02))
    if name.endswith(("resize_layers.0.weight", "resize_layers.1.weight")):
        return np.float32(0), matrix(shape[0])
    return np.float32(0), matrix(int(np.prod(shape[1:])))


def weight(name, shape):
    offset, scale = offset_scale(name, shape)
    index = np.arange(int(np.prod(shape)), dtype=np.uint64)
    with np.errstate(over="ignore"):
        bits = splitmix64(index + np.uint64(fnv1a64(name))) >> np.uint64(40)
    value = (bits.astype(np.float32) * np.float32(2.0**-23) - np.float32(1)) * scale
    if offset:
        value = value + offset
    return value.reshape(shape).astype(np.float64)


def image_u8(seed, h, w):
    y, x, c = np.meshgrid(np.arange(h), np.arange(w), np.arange(3), indexing="ij")
    base = (x * (2 + c) + y * (3 - c) + 37 * seed * (c + 1)) % 256
    stripes = np.where(base < 128, base, 255 - base)
    checker = ((((x >> 4) + seed) ^ (y >> 4)) & 1) * 64
    index = ((y * w + x) * 3 + c).astype(np.uint64)
    with np.errstate(over="ignore"):
        noise = splitmix64(index + np.uint64((seed * 0x1000003 + 0xDA3) & MASK)) >> np.uint64(58)
    return (stripes + checker + noise.astype(np.int64)).astype(np.uint8)


def normalise(u8):
    mean = np.array([0.485, 0.456, 0.406], np.float32)
    std = np.array([0.229, 0.224, 0.225], np.float32)
    return ((u8.astype(np.float32) / np.float32(255) - mean) / std).transpose(2, 0, 1)


# ---------------------------------------------------------------- layers


class Net:
    """One network: its sizes, its keys' beginning, what it has shown."""

    def __init__(self, root, config):
        self.root, self.config, self.shown = root, config, {}

    def show(self, name, value):
        self.shown[name] = np.asarray(value, np.float64)

    def w(self, name, *shape):
        return weight(f"{self.root}.{name}", shape)

    def linear(self, x, name, outputs):
        return x @ self.w(name + ".weight", outputs, x.shape[-1]).T + self.w(name + ".bias", outputs)

    def norm(self, x, name, eps=1e-5):
        n = x.shape[-1]
        centred = x - x.mean(-1, keepdims=True)
        scaled = centred / np.sqrt((centred**2).mean(-1, keepdims=True) + eps)
        return scaled * self.w(name + ".weight", n) + self.w(name + ".bias", n)

    def conv(self, x, name, outputs, side, stride=1, bias=True):
        """x [S, C, h, w]; a border of side // 2 zeros."""
        s, c, h, w = x.shape
        kernel, pad = self.w(name + ".weight", outputs, c, side, side), side // 2
        padded = np.pad(x, ((0, 0), (0, 0), (pad, pad), (pad, pad)))
        oh, ow = (h + 2 * pad - side) // stride + 1, (w + 2 * pad - side) // stride + 1
        out = np.zeros((s, outputs, oh, ow))
        for i in range(side):
            for j in range(side):
                part = padded[:, :, i : i + stride * oh : stride, j : j + stride * ow : stride][:, :, :oh, :ow]
                out += np.einsum("oc,schw->sohw", kernel[:, :, i, j], part)
        return out + self.w(name + ".bias", outputs)[:, None, None] if bias else out

    def spread(self, x, name, side):
        s, c, h, w = x.shape
        kernel = self.w(name + ".weight", c, c, side, side)
        out = np.einsum("coij,schw->sohiwj", kernel, x).reshape(s, c, h * side, w * side)
        return out + self.w(name + ".bias", c)[:, None, None]


def softmax(x):
    e = np.exp(x - x.max(-1, keepdims=True))
    return e / e.sum(-1, keepdims=True)


def turn(x, places):
    """Rotary positions: first half of the channels by the row, second by the column. x [heads, N, d]."""

    def half(t, p):
        n = t.shape[-1] // 2
        angle = p[:, None] * 100.0 ** (-np.arange(n) / n)
        a, b = t[..., :n], t[..., n:]
        return np.concatenate([a * np.cos(angle) - b * np.sin(angle), b * np.cos(angle) + a * np.sin(angle)], -1)

    d = x.shape[-1] // 2
    return np.concatenate([half(x[..., :d], places[:, 0]), half(x[..., d:], places[:, 1])], -1)


def block(net, x, name, heads, ffn, hidden, eps, qk_norm=False, places=None):
    """x [N, D]."""
    n, dim = x.shape
    qkv = net.linear(net.norm(x, f"{name}.norm1", eps), f"{name}.attn.qkv", 3 * dim)
    q, k, v = qkv.reshape(n, 3, heads, dim // heads).transpose(1, 2, 0, 3)
    if qk_norm:
        q, k = net.norm(q, f"{name}.attn.q_norm"), net.norm(k, f"{name}.attn.k_norm")
    if places is not None:
        q, k = turn(q, places), turn(k, places)
    seen = softmax(q @ k.transpose(0, 2, 1) / math.sqrt(dim // heads)) @ v
    seen = net.linear(seen.transpose(1, 0, 2).reshape(n, dim), f"{name}.attn.proj", dim)
    x = x + net.w(f"{name}.ls1.gamma", dim) * seen
    y = net.norm(x, f"{name}.norm2", eps)
    if ffn == "swiglu":
        gate, value = np.split(net.linear(y, f"{name}.mlp.w12", 2 * hidden), 2, -1)
        y = net.linear(gate / (1 + np.exp(-gate)) * value, f"{name}.mlp.w3", dim)
    else:
        y = net.linear(y, f"{name}.mlp.fc1", hidden)
        y = net.linear(0.5 * y * (1 + erf(y / math.sqrt(2))), f"{name}.mlp.fc2", dim)
    return x + net.w(f"{name}.ls2.gamma", dim) * y


# ---------------------------------------------------------------- backbone


def positions(net, rows, columns):
    c = net.config["net"]
    grid, dim = c["position_grid"], c["embed_dim"]
    table = net.w("backbone.pretrained.pos_embed", 1, 1 + grid * grid, dim)[0]
    if (rows, columns) == (grid, grid):
        return table

    def kernel(t, a=-0.75):
        t = abs(t)
        if t <= 1:
            return (a + 2) * t**3 - (a + 3) * t**2 + 1
        return a * t**3 - 5 * a * t**2 + 8 * a * t - 4 * a if t < 2 else 0.0

    def resample(n):
        matrix = np.zeros((n, grid))
        for i in range(n):
            at = (i + 0.5) * grid / (n + 0.1) - 0.5
            for tap in range(math.floor(at) - 1, math.floor(at) + 3):
                matrix[i, min(max(tap, 0), grid - 1)] += kernel(at - tap)
        return matrix

    full = np.einsum("yi,xj,ijd->yxd", resample(rows), resample(columns), table[1:].reshape(grid, grid, dim))
    return np.concatenate([table[:1], full.reshape(-1, dim)])


def reference_view(tokens):
    norms = np.linalg.norm(tokens, axis=1)
    unit = tokens / norms[:, None]
    similarity = (unit @ unit.T - np.eye(len(tokens))).sum(1) / (len(tokens) - 1)
    scaled = lambda v: (v - v.min()) / (v.max() - v.min() + 1e-8)
    parts = (similarity, norms, unit.var(1, ddof=1))
    return int(np.argmin(sum(abs(scaled(p) - 0.5) for p in parts)))


def backbone(net, pixels, cameras=None):
    c, root = net.config["net"], "backbone.pretrained"
    dim, alternate = c["embed_dim"], c["alt_start"]
    s, _, h, w = pixels.shape
    rows, columns = h // 14, w // 14
    kernel = net.w(f"{root}.patch_embed.proj.weight", dim, 3, 14, 14)
    cut = pixels.reshape(s, 3, rows, 14, columns, 14)
    x = np.einsum("dcij,scyixj->syxd", kernel, cut).reshape(s, rows * columns, dim)
    x = x + net.w(f"{root}.patch_embed.proj.bias", dim)
    net.show("patch_embed", x)
    first = np.repeat(net.w(f"{root}.cls_token", 1, 1, dim), s, 0)
    x = np.concatenate([first, x], 1) + positions(net, rows, columns)
    net.show("tokens_in", x)
    patches = [(r + 1.0, q + 1.0) for r in range(rows) for q in range(columns)]
    near = np.array([(0.0, 0.0)] + patches)
    far = np.array([(0.0, 0.0)] + [(1.0, 1.0)] * len(patches))
    order, outs, local = list(range(s)), [], x
    for i in range(c["depth"]):
        later = alternate >= 0 and i >= alternate
        if alternate >= 0 and i == alternate - 1 and s >= 3 and cameras is None:
            best = reference_view(x[:, 0])
            order = [best] + [v for v in range(s) if v != best]
            x = x[order]
            net.show("ref_idx", [best])
        if alternate >= 0 and i == alternate:
            trained = net.w(f"{root}.camera_token", 1, 2, dim)[0]
            x = x.copy()
            x[:, 0] = cameras if cameras is not None else trained[[0] + [1] * (s - 1)]
        one = lambda x, places: block(
            net, x, f"{root}.blocks.{i}", c["num_heads"], c["ffn_layer"], c["ffn_hidden"], 1e-6, later, places
        )
        if later and i % 2 == 1:
            x = one(x.reshape(-1, dim), np.tile(far, (s, 1))).reshape(s, -1, dim)
        else:
            x = np.stack([one(v, near if later else None) for v in x])
            local = x
        net.show(f"block{i:02d}", x)
        if i in c["out_layers"]:
            back = np.argsort(order)
            outs.append((local[back], x[back]))
    features = []
    for k, (local, x) in enumerate(outs):
        normed = net.norm(x, f"{root}.norm")
        if alternate >= 0:
            token, patch = np.concatenate([local, x], -1)[:, 0], np.concatenate([local, normed], -1)[:, 1:]
        else:
            token, patch = x[:, 0], normed[:, 1:]
        net.show(f"camtok{k}", token)
        net.show(f"feat{k}", patch)
        features.append((patch, token))
    return features


# ---------------------------------------------------------------- cameras


def quaternion(m):
    """xyzw with w >= 0, by the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix."""
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2], m[2, 1] - m[1, 2]],
            [m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2], m[0, 2] - m[2, 0]],
            [m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    q = np.linalg.eigh(k)[1][:, -1]
    return -q if q[3] < 0 else q


def rotation(q):
    x, y, z, w = q / np.linalg.norm(q)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def invert(pose):
    out = np.eye(4)
    out[:3, :3] = pose[:3, :3].T
    out[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return out


def normalise_poses(poses):
    moved = np.stack([p @ invert(poses[0]) for p in poses])
    distances = sorted(np.linalg.norm(invert(p)[:3, 3]) for p in moved)
    moved[:, :3, 3] /= max(distances[(len(distances) - 1) // 2], 0.1)
    return moved


def encode_cameras(net, poses, intrinsics, h, w):
    c, dim = net.config["cam_enc"], net.config["net"]["embed_dim"]
    codes = []
    for pose, k in zip(poses, intrinsics):
        there = invert(pose)
        fov = [2 * math.atan(h / 2 / k[1, 1]), 2 * math.atan(w / 2 / k[0, 0])]
        codes.append(np.concatenate([there[:3, 3], quaternion(there[:3, :3]), fov]))
    codes = np.array(codes)
    net.show("cam_enc_pose9", codes)
    x = net.linear(codes, "cam_enc.pose_branch.fc1", dim // 2)
    x = net.linear(0.5 * x * (1 + erf(x / math.sqrt(2))), "cam_enc.pose_branch.fc2", dim)
    x = net.norm(x, "cam_enc.token_norm")
    for i in range(c["trunk_depth"]):
        x = block(net, x, f"cam_enc.trunk.{i}", c["num_heads"], "mlp", c["mlp_ratio"] * dim, 1e-5)
    x = net.norm(x, "cam_enc.trunk_norm")
    net.show("cam_enc_tokens", x)
    return x


def decode_cameras(net, tokens, h, w):
    width, relu = tokens.shape[1], lambda x: np.maximum(x, 0)
    x = relu(net.linear(tokens, "cam_dec.backbone.0", width))
    x = relu(net.linear(x, "cam_dec.backbone.2", width))
    place, turned = net.linear(x, "cam_dec.fc_t", 3), net.linear(x, "cam_dec.fc_qvec", 4)
    fov = relu(net.linear(x, "cam_dec.fc_fov.0", 2))
    net.show("pose_enc", np.concatenate([place, turned, fov], 1))
    poses, intrinsics = [], []
    for t, q, f in zip(place, turned, fov):
        there = np.eye(4)
        there[:3, :3], there[:3, 3] = rotation(q), t
        poses.append(invert(there))
        fx, fy = w / 2 / max(math.tan(f[1] / 2), 1e-6), h / 2 / max(math.tan(f[0] / 2), 1e-6)
        intrinsics.append([[fx, 0, w / 2], [0, fy, h / 2], [0, 0, 1]])
    return np.stack(poses), np.array(intrinsics)


# ---------------------------------------------------------------- heads


def enlarge(x, h, w):
    """Bilinear, corner pixels' centres kept."""

    def matrix(n, m):
        out = np.zeros((m, n))
        for i in range(m):
            at = i * (n - 1) / (m - 1) if m > 1 else 0.0
            low = min(int(at), n - 1)
            out[i, low] += 1 - (at - low)
            out[i, min(low + 1, n - 1)] += at - low
        return out

    return np.einsum("yi,xj,scij->scyx", matrix(x.shape[2], h), matrix(x.shape[3], w), x)


def embed(x, aspect):
    """The head's position embedding."""
    _, c, h, w = x.shape
    d = math.hypot(aspect, 1)
    place = lambda n, side: np.linspace(-side * (n - 1) / n, side * (n - 1) / n, n)
    omega = 100.0 ** (-np.arange(c // 4) / (c // 4))
    waves = lambda p: np.concatenate([np.sin(p[:, None] * omega), np.cos(p[:, None] * omega)], 1)
    across, down = waves(place(w, aspect / d)), waves(place(h, 1 / d))
    whole = np.zeros((h, w, c))
    whole[:, :, : c // 2], whole[:, :, c // 2 :] = across[None], down[:, None]
    return x + 0.1 * whole.transpose(2, 0, 1)


def head(net, features, h, w, dual):
    c, rows, columns, aspect = net.config["head"], h // 14, w // 14, w / h
    f, relu, laterals = c["features"], lambda x: np.maximum(x, 0), []
    for k, (patch, _) in enumerate(features):
        x = net.norm(patch, "head.norm") if dual else patch
        x = x.transpose(0, 2, 1).reshape(len(patch), -1, rows, columns)
        x = net.conv(x, f"head.projects.{k}", c["out_channels"][k], 1)
        net.show(f"head.projects.{k}", x)
        x = embed(x, aspect) if dual else x
        if k < 2:
            x = net.spread(x, f"head.resize_layers.{k}", 4 - 2 * k)
        if k == 3:
            x = net.conv(x, "head.resize_layers.3", x.shape[1], 3, stride=2)
        net.show(f"head.resize_layers.{k}", x)
        x = net.conv(x, f"head.scratch.layer{k + 1}_rn", f, 3, bias=False)
        net.show(f"head.layer{k + 1}_rn", x)
        laterals.append(x)

    def unit(x, name):
        inner = relu(net.conv(relu(x), name + ".conv1", f, 3))
        return x + net.conv(inner, name + ".conv2", f, 3)

    def chain(suffix):
        x = laterals[3]
        for level in (4, 3, 2, 1):
            name = f"head.scratch.refinenet{level}{suffix}"
            if level < 4:
                x = x + unit(laterals[level - 1], name + ".resConfUnit1")
            x = unit(x, name + ".resConfUnit2")
            size = laterals[level - 2].shape[2:] if level > 1 else (8 * rows, 8 * columns)
            x = net.conv(enlarge(x, *size), name + ".out_conv", f, 1)
            net.show(f"head.refinenet{level}{suffix}", x)
        return x

    def pair(x, name, outputs):
        return net.conv(relu(net.conv(x, name + ".0", 32, 3)), name + ".2", outputs, 1)

    x = net.conv(chain(""), "head.scratch.output_conv1", f // 2, 3)
    net.show("head.output_conv1", x)
    x = enlarge(x, h, w)
    x = embed(x, aspect) if dual else x
    net.show("head.output_conv2.in", x)
    logits = pair(x, "head.scratch.output_conv2", 2 if dual else 1)
    net.show("head.output_conv2.logits", logits)
    out = {"depth": np.exp(logits[:, 0])}
    if not dual:
        sky = pair(x, "head.scratch.sky_output_conv2", 1)
        net.show("head.sky_output_conv2.logits", sky)
        net.show("head.depth_before_sky", out["depth"])
        out["sky"] = relu(sky[:, 0])
        return fill_sky(out)
    out["depth_conf"] = 1 + np.exp(logits[:, 1])
    x = chain("_aux")
    for i in range(5):
        x = net.conv(x, f"head.scratch.output_conv1_aux.3.{i}", f if i % 2 else f // 2, 3)
    net.show("head.output_conv1_aux.3", x)
    x = net.conv(embed(x, aspect), "head.scratch.output_conv2_aux.3.0", 32, 3)
    x = net.norm(x.transpose(0, 2, 3, 1), "head.scratch.output_conv2_aux.0.2").transpose(0, 3, 1, 2)
    x = net.conv(relu(x), "head.scratch.output_conv2_aux.3.5", 7, 1)
    net.show("head.output_conv2_aux.3.logits", x)
    out["ray"], out["ray_conf"] = x[:, :6].transpose(0, 2, 3, 1), 1 + np.exp(x[:, 6])
    return out


def fill_sky(out):
    is_open = out["sky"] < 0.3
    depth = out["depth"].copy()
    if is_open.sum() > 10 and (~is_open).sum() > 10:
        depth[~is_open] = np.quantile(depth[is_open], 0.99)
    return {**out, "depth": depth}


def any_view(net, pixels, cameras=None):
    h, w = pixels.shape[2:]
    features = backbone(net, pixels, cameras)
    out = head(net, features, h, w, True)
    out["poses"], out["intrinsics"] = decode_cameras(net, features[3][1], h, w)
    return out


def nested(root, config, pixels):
    anyway = any_view(Net(f"{root}.da3", config["anyview"]), pixels)
    metric_net = Net(f"{root}.da3_metric", config["metric"])
    metric = head(metric_net, backbone(metric_net, pixels), *pixels.shape[2:], False)
    shown = {"any.depth": anyway["depth"], "any.depth_conf": anyway["depth_conf"]}
    shown |= {"metric.depth": metric["depth"], "metric.sky": metric["sky"]}
    k = anyway["intrinsics"]
    metres = metric["depth"] * ((k[:, 0, 0] + k[:, 1, 1]) / 2 / 300)[:, None, None]
    is_open, depth, conf = metric["sky"] < 0.3, anyway["depth"], anyway["depth_conf"]
    assert 10 < is_open.sum() < is_open.size - 10, f"no use as a reference: {is_open.mean()} open"
    used = (conf >= np.quantile(conf[is_open], 0.5)) & is_open & (metres > 0.01) & (depth > 0.001)
    scale = (metres[used] * depth[used]).sum() / (depth[used] ** 2).sum()
    depth = depth * scale
    depth = np.where(is_open, depth, min(np.quantile(depth[is_open], 0.99), 200))
    poses = anyway["poses"].copy()
    poses[:, :3, 3] *= scale
    out = {"depth": depth, "depth_conf": np.where(is_open, conf, 1.0), "poses": poses, "intrinsics": k}
    return shown, out, scale


def align(predicted, given):
    """The similarity from given to predicted camera centres."""
    g = np.stack([invert(p)[:3, 3] for p in given])
    p = np.stack([invert(q)[:3, 3] for q in predicted])
    gc, pc = g - g.mean(0), p - p.mean(0)
    u, d, vt = np.linalg.svd(pc.T @ gc / len(g))
    sign = np.diag([1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    turned, scale = u @ sign @ vt, (d * np.diag(sign)).sum() / ((gc**2).sum() / len(g))
    moved = []
    for pose in given:
        there = invert(pose)
        out = np.eye(4)
        out[:3, :3] = turned @ there[:3, :3]
        out[:3, 3] = scale * turned @ (there[:3, 3] - g.mean(0)) + p.mean(0)
        moved.append(invert(out))
    return scale, np.stack(moved)


# ---------------------------------------------------------------- files


def save(path, tensors):
    names = {"float32": "F32", "float64": "F64", "uint8": "U8", "int64": "I64"}
    header, blob = {}, b""
    for name in sorted(tensors):
        data = np.ascontiguousarray(tensors[name])
        header[name] = {
            "dtype": names[data.dtype.name],
            "shape": list(data.shape),
            "data_offsets": [len(blob), len(blob) + data.nbytes],
        }
        blob += data.tobytes()
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(struct.pack("<Q", len(text)) + text + blob)


def as_f32(tensors):
    whole = lambda name, v: v.astype(np.int64) if name == "ref_idx" else v.astype(np.float32)
    return {name: whole(name, np.asarray(value)) for name, value in tensors.items()}


def outputs(out):
    result = {f"out.{k}": v for k, v in out.items() if k not in ("poses",)}
    result["out.intrinsics"] = out.get("intrinsics")
    if "poses" in out:
        result["out.extrinsics"] = out["poses"][:, :3]
    return {k: v for k, v in result.items() if v is not None}


ANY_VIEW = {
    "net": {
        "name": "tiny", "embed_dim": 48, "depth": 6, "num_heads": 3, "ffn_layer": "mlp", "ffn_hidden": 112,
        "position_grid": 9, "out_layers": [1, 3, 4, 5], "alt_start": 2, "qknorm_start": 2, "rope_start": 2,
    },
    "head": {"dim_in": 96, "features": 16, "out_channels": [8, 12, 16, 20]},
    "cam_enc": {"dim_out": 48, "num_heads": 2, "trunk_depth": 2, "mlp_ratio": 3},
    "cam_dec": {"dim_in": 96},
}
METRIC = {
    "net": {
        "name": "tiny", "embed_dim": 40, "depth": 4, "num_heads": 2, "ffn_layer": "swiglu", "ffn_hidden": 56,
        "position_grid": 5, "out_layers": [0, 1, 2, 3], "alt_start": -1, "qknorm_start": -1, "rope_start": -1,
    },
    "head": {"dim_in": 40, "features": 16, "out_channels": [8, 8, 12, 12]},
}


def pictures(seeds, h, w):
    return np.stack([normalise(image_u8(s, h, w)) for s in seeds])


def entry(kind, name, config, seeds, h, w, **more):
    return {
        "kind": kind, "model": name, "config": {"model_name": name, "config": config}, "views": len(seeds),
        "H": h, "W": w, "input": f"normalize(image_u8(seed,h,w)) for seed in {list(seeds)}", **more,
    }


def main():
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    files = {}

    seeds, h, w = (3, 1, 2), 28, 42
    net, pixels = Net("model", ANY_VIEW), pictures(seeds, h, w)
    out = any_view(net, pixels.astype(np.float64))
    save(folder / "tiny_free_v3.safetensors", as_f32({**net.shown, **outputs(out)}))
    files["tiny_free_v3.safetensors"] = entry("net forward, pose-free", "tiny-any", ANY_VIEW, seeds, h, w)

    seeds, h, w = (1, 2, 3, 4), 42, 28
    net, pixels = Net("model", ANY_VIEW), pictures(seeds, h, w)
    given, known = [], []
    for v in range(4):
        there = np.eye(4)
        there[:3, :3] = rotation(np.array([0.1 * v, -0.2, 0.05 * v * v, 1.0]))
        there[:3, 3] = [1.5 * v, 0.3 * v * v, -0.4 + math.sin(v)]
        given.append(invert(there))
        known.append([[30.0 + v, 0, 14.0], [0, 31.0, 21.0 - v], [0, 0, 1]])
    given, known = np.array(given), np.array(known)
    moved = normalise_poses(given)
    out = any_view(net, pixels.astype(np.float64), encode_cameras(net, moved, known, h, w))
    scale, there = align(out["poses"], given)
    keep = {k: v for k, v in net.shown.items() if not k.startswith("head.") and k != "ref_idx"}
    keep |= outputs(out) | {"in_extrinsics": given, "in_intrinsics": known, "proc_intrinsics": known}
    keep |= {"norm_extrinsics": moved, "api_true.depth": out["depth"] / scale, "api_true.intrinsics": known}
    keep |= {"api_true.extrinsics": given[:, :3], "api_false.extrinsics": there, "api_false.intrinsics": known}
    tensors = as_f32(keep) | {"api.umeyama_scale_f64": np.array([scale])}
    for name in ("in_extrinsics", "in_intrinsics"):
        tensors[name] = keep[name].astype(np.float64)
    save(folder / "tiny_posed_v4.safetensors", tensors)
    files["tiny_posed_v4.safetensors"] = entry(
        "pose-conditioned", "tiny-any", ANY_VIEW, seeds, h, w, source_hw=[h, w], process_res=42
    )

    seeds, h, w = (1, 5), 42, 56
    net, pixels = Net("model", METRIC), pictures(seeds, h, w)
    out = head(net, backbone(net, pixels.astype(np.float64)), h, w, False)
    save(folder / "tiny_metric_v2.safetensors", as_f32({**net.shown, **outputs(out)}))
    files["tiny_metric_v2.safetensors"] = entry("net forward, pose-free", "tiny-metric", METRIC, seeds, h, w)

    pair = {"anyview": ANY_VIEW, "metric": METRIC}
    shown, out, scale = nested("model", pair, pixels.astype(np.float64))
    tensors = as_f32(shown | outputs(out)) | {"out.scale_factor_f64": np.array([scale])}
    save(folder / "tiny_nested_v2.safetensors", tensors)
    files["tiny_nested_v2.safetensors"] = entry("NestedDepthAnything3Net forward", "tiny-nested", pair, seeds, h, w)

    text = json.dumps({"made_by": "tools/make_da3_goldens.py", "precision": "float64 numpy", "files": files}, indent=1)
    (folder / "manifest.json").write_text(text + "\n")


if __name__ == "__main__":
    main()
