"""Clips from the renderer: the binary stream of `stream_views`, and scenes made of it."""

from __future__ import annotations

import queue
import random
import struct
import subprocess
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from torch import Tensor

from .geometry import gauge, homogeneous, inverse, normalised_poses, pose_vector

MAGIC = b"VIDARCL1"
ROOMS_APART = 1 << 20  # between the first rooms of two renderers
HEAD = struct.Struct("<8sQIIII4f")
MEAN = torch.tensor([0.485, 0.456, 0.406]).view(1, 1, 3, 1, 1)
STD = torch.tensor([0.229, 0.224, 0.225]).view(1, 1, 3, 1, 1)


@dataclass
class Clip:
    """Views of one place: image [V, H, W, 3] u8, depth [V, H, W] m (0: none), pose [V, 3, 4], focal fx, fy (px)."""

    seed: int
    number: int
    image: np.ndarray
    depth: np.ndarray
    world_from_camera: np.ndarray
    focal: tuple[float, float]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.image.shape[1], self.image.shape[2]


def read_exactly(source: BinaryIO, count: int) -> bytes | None:
    """`count` bytes, or None at the end of the stream."""
    data = source.read(count)
    if not data:
        return None
    while len(data) < count:
        more = source.read(count - len(data))
        if not more:
            raise ValueError(f"the stream ends within a clip: {len(data)} of {count} bytes")
        data += more
    return data


def read_clip(source: BinaryIO) -> Clip | None:
    """The next clip, or None at the end."""
    head = read_exactly(source, HEAD.size)
    if head is None:
        return None
    magic, seed, number, views, width, height, fx, fy, _, _ = HEAD.unpack(head)
    if magic != MAGIC:
        raise ValueError(f"expected {MAGIC!r}, found {magic!r}")

    def array(dtype: str, *shape: int) -> np.ndarray:
        count = int(np.prod(shape)) * np.dtype(dtype).itemsize
        data = read_exactly(source, count)
        if data is None:
            raise ValueError("the stream ends within a clip")
        return np.frombuffer(data, dtype).reshape(shape)

    poses = array("<f4", views, 3, 4)
    image = array("u1", views, height, width, 3)
    depth = array("<f4", views, height, width)
    return Clip(seed, number, image, depth, poses, (fx, fy))


def write_clip(clip: Clip, out: BinaryIO) -> None:
    """The inverse of `read_clip`."""
    (height, width), views = clip.size, clip.image.shape[0]
    centre = (0.5 * (width - 1), 0.5 * (height - 1))
    out.write(HEAD.pack(MAGIC, clip.seed, clip.number, views, width, height, *clip.focal, *centre))
    out.write(clip.world_from_camera.astype("<f4").tobytes())
    out.write(clip.image.tobytes())
    out.write(clip.depth.astype("<f4").tobytes())


@dataclass
class Scenes:
    """A batch of scenes in the gauge of the network, view 0 the reference.

    images [B, S, 3, H, W] normalised; depth [B, S, H, W] (0: none); first_from_camera [B, S, 4, 4]; focal [B, S, 2] px;
    pose9 [B, S, 9] what the camera encoder is given; scale [B] metres per unit.
    """

    images: Tensor
    depth: Tensor
    first_from_camera: Tensor
    focal: Tensor
    pose9: Tensor
    scale: Tensor


def normalise(image: np.ndarray, device: str = "cpu") -> Tensor:
    """u8 [B, S, H, W, 3] -> [B, S, 3, H, W]."""
    # Bytes travel to the device, a quarter of what floats would be.
    tensor = torch.from_numpy(np.ascontiguousarray(image)).to(device).permute(0, 1, 4, 2, 3).float()
    return (tensor / 255 - MEAN.to(device)) / STD.to(device)


def scenes(parts: list[tuple[Clip, list[int], bool]], device: str = "cpu") -> Scenes:
    """Scenes of the same size from clips, the views to take in their order, and whether to mirror."""
    images, depths, poses, focals = [], [], [], []
    for clip, views, mirrored in parts:
        image, depth, pose = clip.image[views], clip.depth[views], clip.world_from_camera[views].astype(np.float64)
        if mirrored:
            image, depth = image[:, :, ::-1], depth[:, :, ::-1]
            flip = np.diag([-1.0, 1.0, 1.0])
            pose = np.concatenate([flip @ pose[:, :, :3] @ flip, flip @ pose[:, :, 3:]], 2)
        images.append(image)
        depths.append(depth)
        poses.append(pose)
        focals.append(np.tile(np.float32(clip.focal), (len(views), 1)))
    depth = torch.from_numpy(np.ascontiguousarray(np.stack(depths))).to(device).float()
    world_from_camera = homogeneous(torch.from_numpy(np.stack(poses)))
    first_from_camera = (inverse(world_from_camera[:, :1]) @ world_from_camera).float().to(device)
    focal = torch.from_numpy(np.stack(focals)).to(device)
    height, width = depth.shape[-2:]
    scale = gauge(depth, first_from_camera, focal)
    given = normalised_poses(first_from_camera)
    pose9 = pose_vector(given, focal, height, width)
    first_from_camera = first_from_camera.clone()
    first_from_camera[..., :3, 3] /= scale[:, None, None]
    return Scenes(
        normalise(np.stack(images), device), depth / scale[:, None, None, None], first_from_camera, focal, pose9, scale
    )


class Renderer:
    """The renderer as a process for each list of arguments, read by a thread each into one bounded queue."""

    def __init__(self, program: Path, arguments: list[list[str]], ahead: int = 32) -> None:
        # A renderer keeps to one thread; the trainer has the rest.
        environment = {"RAYON_NUM_THREADS": "1", "PATH": "/usr/bin:/bin"}
        self.processes = [
            subprocess.Popen([str(program), *own], stdout=subprocess.PIPE, env=environment) for own in arguments
        ]
        self.queue: queue.Queue[Clip | None] = queue.Queue(ahead)
        self.stopped = False
        for process in self.processes:
            threading.Thread(target=self._read, args=(process.stdout,), daemon=True).start()

    def _read(self, source: BinaryIO) -> None:
        while not self.stopped:
            try:
                clip = read_clip(source)
            except ValueError:
                clip = None
            self.queue.put(clip)
            if clip is None:
                return

    def __iter__(self) -> Iterator[Clip]:
        ended = 0
        while ended < len(self.processes):
            clip = self.queue.get()
            if clip is None:
                ended += 1
            else:
                yield clip

    def stop(self) -> None:
        """Ends the processes."""
        self.stopped = True
        for process in self.processes:
            process.terminate()


class Pool:
    """A shuffled store of clips by size; a clip leaves when as much of it was given out as `uses` times the whole."""

    def __init__(self, source: Iterator[Clip], capacity: int, uses: int, rng: random.Random) -> None:
        self.source, self.capacity, self.uses, self.rng = source, capacity, uses, rng
        self.clips: list[list] = []
        self.rooms = 0
        self.views = 0

    def _fill(self, count: int) -> None:
        while len(self.clips) < count:
            clip = next(self.source)
            self.views += clip.image.shape[0]
            # Renderers are about as far as each other, each from its own first room.
            self.rooms = max(self.rooms, (clip.seed & 0xFFFF_FFFF) % ROOMS_APART + 1)
            self.clips.append([clip, self.uses])

    def draw(self, count: int, wanted: tuple[int, int] | None = None, share: float = 1.0) -> list[Clip]:
        """`count` clips of one size (height, width), the wanted one where there are enough; a share of each is used."""
        # At the start the pool grows while it is used, so that training need not wait for it.
        self._fill(min(self.capacity, max(4 * count, len(self.clips) + round(share * count))))
        of_wanted = [clip for clip, _ in self.clips if clip.size == wanted]
        first = self.rng.choice(of_wanted) if len(of_wanted) >= count else self.rng.choice(self.clips)[0]
        places = [
            i
            for i, (clip, _) in enumerate(self.clips)
            if clip.size == first.size and len(clip.image) == len(first.image)
        ]
        chosen = self.rng.sample(places, min(count, len(places)))
        found = [self.clips[i][0] for i in chosen]
        for i in chosen:
            self.clips[i][1] -= share
        self.clips = [entry for entry in self.clips if entry[1] > 1e-6]
        return found


def clips_of(path: Path) -> list[Clip]:
    """All clips of a file."""
    found = []
    with path.open("rb") as source:
        while (clip := read_clip(source)) is not None:
            found.append(clip)
    return found
