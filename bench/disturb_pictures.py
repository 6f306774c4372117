#!/usr/bin/env python3
"""Does to the pictures of a recording that `vidar synth` made what cameras and their carriers do. Needs numpy, scipy and Pillow.

    disturb_pictures.py RECORDING OUT KIND

Kinds: carrier (a textured fifth at the bottom and a dark corner move with the camera), walkers (two textured ellipses, a third of the width
each, cross the picture again and again), breathing (the focal length changes
by -1 to 1.5 % every few seconds), exposure (steps of up to a factor of 2.3), flicker (18 % at 100 Hz, row by row in 28 ms).
"""

import pathlib
import shutil
import sys

import numpy as np
from PIL import Image
from scipy.ndimage import affine_transform, zoom


def texture(height, width, seed):
    random = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for size in (4, 12, 40):
        grid = random.random((max(2, height // size), max(2, width // size)))
        total += zoom(grid, (height / grid.shape[0], width / grid.shape[1]), order=1)[:height, :width]
    return 30 + 190 * (total - total.min()) / np.ptp(total)


def steps(times, random, low, high, shortest, longest, share):
    """A value that goes to another one drawn from low to high now and then."""
    values, value, target, change = [], 0.0, 0.0, shortest
    for time in times:
        if time > change:
            target, change = random.uniform(low, high), change + random.uniform(shortest, longest)
        value += (target - value) * share
        values.append(value)
    return values


class Disturbance:
    def __init__(self, kind, stamps, shape):
        self.height, self.width = shape
        self.times = (stamps - stamps[0]) * 1e-9
        random = np.random.default_rng(7)
        self.random = random
        self.paint = getattr(self, kind)
        self.zooms = steps(self.times, random, -0.01, 0.015, 2, 5, 0.2)
        self.gains = [2**v for v in steps(self.times, random, -1.2, 1.0, 0.8, 3, 0.35)]
        self.strip = texture(int(0.22 * self.height), self.width, 3)
        y, x = np.mgrid[: self.height, : self.width]
        self.corner = np.clip(1.3 - np.hypot((x - 0.98 * self.width) / (0.16 * self.width), y / (0.25 * self.height)), 0, 1)
        self.body = texture(int(0.9 * self.height), int(0.35 * self.width), 5)
        y, x = np.mgrid[: self.body.shape[0], : self.body.shape[1]]
        self.inside = (2 * x / self.body.shape[1] - 1) ** 2 + (2 * y / self.body.shape[0] - 1) ** 2 < 1

    def carrier(self, image, _):
        image[-len(self.strip) :] = self.strip + self.random.normal(0, 2, self.strip.shape)
        return image * (1 - self.corner) + 20 * self.corner

    def walkers(self, image, k):
        height, width = self.body.shape
        for every, begin, to_right in ((7, 1.5, True), (9, 5, False)):
            way = ((self.times[k] - begin) % every) / 4
            if self.times[k] < begin or way >= 1:
                continue
            left = int((self.width + width) * way) - width if to_right else int(self.width - (self.width + width) * way)
            top = int(0.1 * self.height + 8 * np.sin(2 * np.pi * 1.8 * self.times[k]))
            first, end, bottom = max(0, left), min(self.width, left + width), min(self.height, top + height)
            if end > first:
                part = (slice(0, bottom - top), slice(first - left, end - left))
                area, inside = image[top:bottom, first:end], self.inside[part]
                area[inside] = (self.body[part] + self.random.normal(0, 2, inside.shape))[inside]
        return image

    def breathing(self, image, k):
        scale = 1 / (1 + self.zooms[k])
        middle = (1 - scale) * (np.array(image.shape) - 1) / 2
        return affine_transform(image, np.eye(2) * scale, offset=middle, order=1, mode="nearest")

    def exposure(self, image, k):
        return image * self.gains[k]

    def flicker(self, image, k):
        rows = self.times[k] + np.arange(self.height) / self.height * 0.028
        return image * (1 + 0.18 * np.sin(2 * np.pi * 100 * rows))[:, None]


def main():
    source, out, kind = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), sys.argv[3]
    shutil.copytree(source, out, ignore=lambda folder, names: names if folder.endswith("cam0/data") else [])
    files = sorted((source / "mav0/cam0/data").iterdir())
    stamps = np.array([int(file.stem) for file in files])
    read = lambda file: np.asarray(Image.open(file).convert("L")).astype(float)
    disturbance = Disturbance(kind, stamps, read(files[0]).shape)
    for k, file in enumerate(files):
        image = np.clip(disturbance.paint(read(file), k), 0, 255).astype(np.uint8)
        quality = {"quality": 85} if file.suffix == ".jpg" else {}
        Image.fromarray(image).save(out / "mav0/cam0/data" / file.name, **quality)


if __name__ == "__main__":
    main()
