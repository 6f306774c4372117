"""Writes reference files by which `vidar-da3` is compared with this code (`crates/vidar-da3/tests/nano_parity.rs`).

    python -m nano.golden --out ../crates/vidar-da3/tests/data/nano [--model ../models/da3-nano]

Without `--model` the weights are synthetic, the same on both sides, so that the files need no checkpoint.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save_file
from torch import Tensor

from .config import NanoConfig
from .data import normalise
from .export import exported, imported, read
from .geometry import homogeneous, inverse, normalised_poses, pose_vector
from .model import Nano, Output

MASK = (1 << 64) - 1
SIZE = (42, 56)  # rows and columns of the pictures, pixels


def fnv1a(text: str) -> int:
    """64-bit FNV-1a."""
    value = 0xCBF29CE484222325
    for byte in text.encode():
        value = ((value ^ byte) * 0x100000001B3) & MASK
    return value


def splitmix(x: np.ndarray) -> np.ndarray:
    """SplitMix64 of u64 numbers."""
    with np.errstate(over="ignore"):
        x = x + np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return x ^ (x >> np.uint64(31))


def spread(name: str, shape: tuple[int, ...]) -> tuple[float, float]:
    """Offset and scale of a tensor's numbers by rule."""
    leaf = name.rsplit(".", 1)[-1]
    named = {"gamma": (0.5, 0.1), "cls_token": (0, 1.0), "camera_token": (0, 1.0), "pos_embed": (0, 0.5)}
    if leaf in named:
        return named[leaf]
    if name.endswith("cam_dec.fc_fov.0.bias"):
        return 1.0, 0.02
    gains = {
        "cam_dec.fc_fov.0.weight": 0.125,
        "scratch.output_conv2.2.weight": 0.25,
        "scratch.output_conv2_aux.3.5.weight": 0.5,
    }
    gain = next((g for ending, g in gains.items() if name.endswith(ending)), None)
    if gain is None and len(shape) == 1:
        return (1.0, 0.1) if leaf == "weight" else (0.0, 0.02)
    transposed = name.endswith(("resize_layers.0.weight", "resize_layers.1.weight"))
    fan = shape[0] if transposed else (shape[1] if gain else int(np.prod(shape[1:])))
    return 0.0, (gain or 1.0) * float(np.sqrt(3.0 / fan))


def by_rule(name: str, shape: tuple[int, ...]) -> Tensor:
    """The tensor of a key."""
    offset, scale = spread(name, shape)
    with np.errstate(over="ignore"):
        bits = splitmix(np.arange(int(np.prod(shape)), dtype=np.uint64) + np.uint64(fnv1a(name))) >> np.uint64(40)
    value = (bits.astype(np.float32) * np.float32(2.0**-23) - np.float32(1)) * np.float32(scale)
    if offset:
        value = value + np.float32(offset)
    return torch.from_numpy(value.reshape(shape))


def picture(seed: int, height: int, width: int) -> np.ndarray:
    """[H, W, 3] u8, made by rule."""
    y, x, c = np.meshgrid(np.arange(height), np.arange(width), np.arange(3), indexing="ij")
    base = (x * (2 + c) + y * (3 - c) + 37 * seed * (c + 1)) % 256
    stripes = np.where(base < 128, base, 255 - base)
    checks = ((((x >> 4) + seed) ^ (y >> 4)) & 1) * 64
    index = ((y * width + x) * 3 + c).astype(np.uint64) + np.uint64(seed * 0x1000003 + 0xDA3)
    return (stripes + checks + (splitmix(index) >> np.uint64(58)).astype(np.int64)).astype(np.uint8)


def ruled_network(config: NanoConfig) -> Nano:
    """The network whose weights are made by rule."""
    return imported({n: by_rule(n, tuple(t.shape)) for n, t in exported(Nano(config)).items()}, config)


def poses(views: int) -> Tensor:
    """Some `world_from_camera` [1, S, 4, 4] that are not collinear."""
    turn = torch.arange(views, dtype=torch.float64)
    matrices = []
    for a in turn.tolist():
        x, y, z = 0.15 * a, -0.1 * a * a, 0.05 * a
        rx = torch.tensor([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
        ry = torch.tensor([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
        rz = torch.tensor([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
        centre = torch.tensor([[0.4 * a], [0.1 * a * a], [np.sin(2.0 * a)]])
        matrices.append(torch.cat([(rx @ ry @ rz).double(), centre.double()], 1))
    return homogeneous(torch.stack(matrices))[None]


class Recorder:
    """Keeps what the layers of a network give."""

    def __init__(self, model: Nano) -> None:
        self.found: dict[str, Tensor] = {}
        backbone = model.backbone["pretrained"]
        backbone.patch_embed.register_forward_hook(lambda m, i, o: self.found.update(patch_embed=o))
        for k in (0, 3, 7, 11):
            backbone.blocks[k].register_forward_hook(self.keep(f"block{k:02}"))
        for k in range(4):
            layer = getattr(model.head.scratch, f"layer{k + 1}_rn")
            layer.register_forward_hook(lambda m, i, o, k=k: self.found.update({f"head.layer{k + 1}_rn": o}))

    def keep(self, name: str):  # noqa: ANN201
        return lambda m, i, o: self.found.update({name: o})


@torch.no_grad()
def case(model: Nano, seeds: list[int], posed: bool) -> dict[str, np.ndarray]:
    """Names and numbers of one reference file."""
    height, width = SIZE
    images = normalise(np.stack([picture(s, height, width) for s in seeds])[None])
    views = len(seeds)
    tensors: dict[str, Tensor] = {}
    pose9 = None
    if posed:
        world_from_camera = poses(views)
        given = normalised_poses(world_from_camera)
        focal = torch.tensor([[50.0, 45.0], [52.0, 47.0], [48.0, 44.0], [51.0, 46.0]])[None, :views]
        pose9 = pose_vector(given, focal.double(), height, width).float()
        intrinsics = torch.zeros(views, 3, 3, dtype=torch.float64)
        intrinsics[:, 0, 0], intrinsics[:, 1, 1], intrinsics[:, 2, 2] = focal[0, :, 0], focal[0, :, 1], 1
        intrinsics[:, 0, 2], intrinsics[:, 1, 2] = 0.5 * width, 0.5 * height
        tensors |= {
            "in_extrinsics": inverse(world_from_camera)[0],
            "in_intrinsics": intrinsics,
            "proc_intrinsics": intrinsics.float(),
            "norm_extrinsics": inverse(given)[0].float(),
            "cam_enc_pose9": pose9[0],
            "cam_enc_tokens": model.cam_enc(pose9)[0],
        }
    recorder = Recorder(model)
    output = model(images, pose9, wants_rays=True, select=True)
    features, _ = model.backbone["pretrained"](images, None if pose9 is None else model.cam_enc(pose9), True)
    for name, value in recorder.found.items():
        tensors[name] = value if "head." in name or name == "patch_embed" else value.reshape(views, -1, value.shape[-1])
    for k, (patches, camera) in enumerate(features):
        tensors[f"feat{k}"], tensors[f"camtok{k}"] = patches[0], camera[0]
    tensors |= answers(output, height, width)
    if not posed:
        tensors["ref_idx"] = output.reference.reshape(1)
    return {name: t.contiguous().numpy() for name, t in tensors.items()}


def answers(output: Output, height: int, width: int) -> dict[str, Tensor]:
    """The network's answers as inference gives them."""
    fov = output.pose_enc[0, :, 7:]
    focal = 0.5 * torch.tensor([height, width]) / (0.5 * fov).tan().clamp(min=1e-6)
    intrinsics = torch.zeros(len(fov), 3, 3)
    intrinsics[:, 0, 0], intrinsics[:, 1, 1], intrinsics[:, 2, 2] = focal[:, 1], focal[:, 0], 1
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = 0.5 * width, 0.5 * height
    return {
        "pose_enc": output.pose_enc[0],
        "out.depth": output.depth[0],
        "out.depth_conf": output.depth_conf[0],
        "out.ray": output.ray[0].permute(0, 2, 3, 1),
        "out.ray_conf": output.ray_conf[0],
        "out.extrinsics": inverse(homogeneous(output.world_from_camera()))[0, :, :3],
        "out.intrinsics": intrinsics,
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--model", type=Path, help="a folder with config.json and model.safetensors")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    model = read(arguments.model) if arguments.model else ruled_network(NanoConfig())
    prefix = "trained" if arguments.model else "ruled"
    manifest = arguments.out / "manifest.json"
    files = json.loads(manifest.read_text())["files"] if manifest.exists() else {}
    height, width = SIZE
    for kind, posed, seeds in (("net forward, pose-free", False, [3, 1, 2]), ("pose-conditioned", True, [1, 2, 3, 4])):
        name = f"{prefix}_{'posed' if posed else 'free'}_v{len(seeds)}.safetensors"
        save_file(case(model, seeds, posed), arguments.out / name)
        entry = {"kind": kind, "model": model.config.name, "config": model.config.to_json(), "views": len(seeds)}
        entry |= {"H": height, "W": width, "input": f"normalize(image_u8(seed,h,w)) for seed in {seeds}"}
        files[name] = entry | ({"source_hw": [height, width], "process_res": max(SIZE)} if posed else {})
    text = json.dumps({"made_by": "training/nano/golden.py", "precision": "float32 torch", "files": files}, indent=1)
    manifest.write_text(text + "\n")


if __name__ == "__main__":
    main()
