"""Real frames with depth and poses, for evaluation only: 7-Scenes and a HoloLens recording, brought to one size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from .data import Clip

# 7-Scenes: the colour camera differs from the depth camera, to which intrinsics and poses belong.
SCENES7_DEPTH_FOCAL, SCENES7_DEPTH_CENTRE = 585.0, (320.0, 240.0)
SCENES7_COLOUR_FOCAL, SCENES7_COLOUR_CENTRE = 523.5, (319.8, 233.5)
SCENES7_COLOUR_FROM_DEPTH_M = np.array([-0.023, 0.012, 0.0])


def cropped(size: tuple[int, int], centre: tuple[float, float], aspect: float) -> tuple[int, int, int, int]:
    """The largest box (left, top, right, bottom) of `aspect` about the principal point."""
    width, height = size
    half_w = min(centre[0], width - centre[0])
    half_h = min(centre[1], height - centre[1])
    half_w, half_h = min(half_w, aspect * half_h), min(half_h, half_w / aspect)
    left, top = round(centre[0] - half_w), round(centre[1] - half_h)
    return left, top, left + round(2 * half_w), top + round(2 * half_h)


def resized_colour(path: Path, box: tuple[int, int, int, int], size: tuple[int, int]) -> np.ndarray:
    """[H, W, 3] u8 of a part of a picture."""
    height, width = size
    image = Image.open(path).convert("RGB").crop(box).resize((width, height), Image.Resampling.BOX)
    return np.asarray(image)


def splatted(points: np.ndarray, focal: tuple[float, float], size: tuple[int, int]) -> np.ndarray:
    """z-depth [H, W] of the nearest points [k, 3] per pixel of a camera with a central principal point; 0: none."""
    height, width = size
    z = points[:, 2]
    u = np.floor(focal[0] * points[:, 0] / z + 0.5 * width).astype(int)
    v = np.floor(focal[1] * points[:, 1] / z + 0.5 * height).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    depth = np.full(height * width, np.inf, np.float32)
    np.minimum.at(depth, v[inside] * width + u[inside], z[inside].astype(np.float32))
    return np.where(np.isfinite(depth), depth, 0).reshape(height, width)


def unprojected(millimetres: np.ndarray, focal: tuple[float, float], centre: tuple[float, float]) -> np.ndarray:
    """Points [k, 3] (m) of a depth image in mm; 0 and 65535 are none."""
    v, u = np.nonzero((millimetres > 0) & (millimetres < 65535))
    z = millimetres[v, u] / 1000.0
    return np.stack([(u - centre[0]) / focal[0] * z, (v - centre[1]) / focal[1] * z, z], 1)


def kitchen(folder: Path, size: tuple[int, int], stride: int, views: int) -> list[Clip]:
    """Clips of 7-Scenes `redkitchen`, every `stride`-th frame."""
    height, width = size
    box = cropped((640, 480), SCENES7_COLOUR_CENTRE, width / height)
    scale = (width / (box[2] - box[0]), height / (box[3] - box[1]))
    focal = (SCENES7_COLOUR_FOCAL * scale[0], SCENES7_COLOUR_FOCAL * scale[1])
    frames = []
    for colour in sorted((folder / "seq-01").glob("*.color.jpg")):
        depth = np.asarray(Image.open(str(colour).replace("color.jpg", "depth.png")))
        pose = np.loadtxt(str(colour).replace("color.jpg", "pose.txt"))
        points = unprojected(depth, (SCENES7_DEPTH_FOCAL,) * 2, SCENES7_DEPTH_CENTRE) + SCENES7_COLOUR_FROM_DEPTH_M
        pose[:3, 3] -= pose[:3, :3] @ SCENES7_COLOUR_FROM_DEPTH_M
        frames.append((resized_colour(colour, box, size), splatted(points, focal, size), pose[:3]))
    return grouped(frames, focal, stride, views)


def commonroom(folder: Path, size: tuple[int, int], stride: int, views: int) -> list[Clip]:
    """Clips of the HoloLens recording."""
    height, width = size
    k = np.loadtxt(folder / "K.txt")
    centre = (k[0, 2], k[1, 2])
    box = cropped((540, 360), centre, width / height)
    scale = (width / (box[2] - box[0]), height / (box[3] - box[1]))
    focal = (k[0, 0] * scale[0], k[1, 1] * scale[1])
    poses = np.loadtxt(folder / "poses.txt").reshape(-1, 4, 4)
    frames = []
    for image, pose in zip(sorted((folder / "images").glob("*.png")), poses, strict=True):
        depth = np.asarray(Image.open(folder / "depth" / image.name))
        points = unprojected(depth, (k[0, 0], k[1, 1]), centre)
        frames.append((resized_colour(image, box, size), splatted(points, focal, size), pose[:3]))
    return grouped(frames, focal, stride, views)


def grouped(frames: list[tuple], focal: tuple[float, float], stride: int, views: int) -> list[Clip]:
    """Clips of `views` frames, `stride` apart, beginning every `views * stride / 2` frames."""
    span = stride * (views - 1) + 1
    clips = []
    for first in range(0, len(frames) - span + 1, max(1, span // 2)):
        chosen = frames[first : first + span : stride]
        image, depth, pose = (np.stack([f[i] for f in chosen]) for i in range(3))
        clips.append(Clip(0, first, image, depth, pose.astype(np.float32), focal))
    return clips


def real_clips(shared: Path, size: tuple[int, int], views: int) -> dict[str, list[Clip]]:
    """By name; empty where the recordings are not there."""
    found = {}
    if (shared / "7scenes_redkitchen").exists():
        found["7-Scenes redkitchen"] = kitchen(shared / "7scenes_redkitchen", size, max(1, 40 // views), views)
    if (shared / "hololens_commonroom").exists():
        found["HoloLens room"] = commonroom(shared / "hololens_commonroom", size, max(1, 24 // views), views)
    return found
