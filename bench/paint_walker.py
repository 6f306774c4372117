#!/usr/bin/env python3
"""Paints a walker into a recording that `vidar synth` made, and writes masks of it.

The walker is a textured board of 0.6 m x 1.4 m that faces the camera and follows it at 0.6 times its motion, 1.3 m ahead of it at first:
stereo sees it consistently at a distance where nothing is. Needs numpy and Pillow.

    paint_walker.py RECORDING OUT        # OUT/recording and OUT/masks (black: the walker)
"""

import csv
import pathlib
import re
import shutil
import sys

import numpy as np
from PIL import Image

HALF_WIDTH_M, HALF_HEIGHT_M, AHEAD_M, SPEED = 0.3, 0.7, 1.3, 0.6


def camera_of(path):
    text = path.read_text()
    numbers = lambda key: [float(v) for v in re.search(key + r": \[([^\]]*)\]", text)[1].split(",")]
    return np.array(numbers("data")).reshape(4, 4), numbers("intrinsics"), numbers("distortion_coefficients")


def poses_of(path, body_from_camera):
    poses = {}
    for row in csv.reader(path.open()):
        if row[0].startswith("#"):
            continue
        x, y, z, qw, qx, qy, qz = map(float, row[1:8])
        pose = np.eye(4)
        pose[:3, :3] = [
            [1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy)],
            [2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx)],
            [2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)],
        ]
        pose[:3, 3] = [x, y, z]
        poses[int(row[0])] = pose @ body_from_camera
    return poses


def rays_of(width, height, intrinsics, distortion):
    """Undistorted x/z and y/z of every pixel, by fixed-point iteration."""
    fu, fv, cu, cv = intrinsics
    k1, k2, p1, p2 = distortion
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    xd, yd = (u - cu) / fu, (v - cv) / fv
    x, y = xd.copy(), yd.copy()
    for _ in range(30):
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        x, y = (
            (xd - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / radial,
            (yd - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / radial,
        )
    return x, y


def main():
    source, out = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2])
    shutil.copytree(source, out / "recording")
    (out / "masks").mkdir()
    mav = out / "recording" / "mav0"
    body_from_camera, intrinsics, distortion = camera_of(mav / "cam0" / "sensor.yaml")
    poses = poses_of(mav / "state_groundtruth_estimate0" / "data.csv", body_from_camera)
    stamps = np.array(sorted(poses))
    texture = np.random.default_rng(7).integers(20, 236, (96, 48)).astype(np.uint8)
    texture = np.array(Image.fromarray(texture).resize((480, 960), Image.BICUBIC))
    rays = start = None
    for file in sorted((mav / "cam0" / "data").glob("*.png")):
        image = np.array(Image.open(file))
        height, width = image.shape
        rays = rays if rays is not None else rays_of(width, height, intrinsics, distortion)
        pose = poses[int(stamps[np.argmin(np.abs(stamps - int(file.stem)))])]
        ahead = (pose @ [0, 0, AHEAD_M, 1])[:3]
        start = start if start is not None else ahead
        walker = start + SPEED * (ahead - start)
        x, y, z = (np.linalg.inv(pose) @ [*walker, 1])[:3]
        across, down = rays[0] * z - x, rays[1] * z - y
        covered = (abs(across) < HALF_WIDTH_M) & (abs(down) < HALF_HEIGHT_M) & (z > 0.4)
        column = ((across + HALF_WIDTH_M) / (2 * HALF_WIDTH_M) * 479).clip(0, 479).astype(int)
        row = ((down + HALF_HEIGHT_M) / (2 * HALF_HEIGHT_M) * 959).clip(0, 959).astype(int)
        Image.fromarray(np.where(covered, texture[row, column], image)).save(file)
        Image.fromarray(np.where(covered, 0, 255).astype(np.uint8)).save(out / "masks" / file.name)


if __name__ == "__main__":
    main()
