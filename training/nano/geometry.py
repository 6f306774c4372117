"""Rotations, cameras and the gauge in which the network answers.

Poses are 3 x 4 or 4 x 4 matrices `a_from_b`; quaternions are xyzw; focal lengths are pixels of the processed image,
whose first pixel's centre is (0.5, 0.5) here (the network's convention); lengths are metres before `gauge` and relative
after.
"""

from __future__ import annotations

import torch
from torch import Tensor


def homogeneous(pose: Tensor) -> Tensor:
    """[..., 3, 4] -> [..., 4, 4]."""
    last = torch.zeros_like(pose[..., :1, :])
    last[..., 3] = 1
    return torch.cat([pose, last], dim=-2)


def inverse(pose: Tensor) -> Tensor:
    """Inverse of rigid [..., 4, 4]."""
    rotation, translation = pose[..., :3, :3], pose[..., :3, 3:]
    back = rotation.transpose(-1, -2)
    return homogeneous(torch.cat([back, -back @ translation], dim=-1))


def quaternion_from_matrix(matrix: Tensor) -> Tensor:
    """[..., 3, 3] -> xyzw with w >= 0, by the largest of four candidates."""
    m = matrix
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    squares = torch.stack([1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22], -1)
    size = squares.clamp(min=0).sqrt()
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    s = size * size
    candidates = torch.stack(
        [
            torch.stack([a, b, c, s[..., 0]], -1),
            torch.stack([s[..., 1], d, e, a], -1),
            torch.stack([d, s[..., 2], f, b], -1),
            torch.stack([e, f, s[..., 3], c], -1),
        ],
        -2,
    )
    candidates = candidates / (2 * size.clamp(min=0.1)).unsqueeze(-1)
    best = size.argmax(-1)[..., None, None].expand(*size.shape[:-1], 1, 4)
    quaternion = candidates.gather(-2, best).squeeze(-2)
    return torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)


def matrix_from_quaternion(quaternion: Tensor) -> Tensor:
    """xyzw of any length [..., 4] -> [..., 3, 3]."""
    x, y, z, w = quaternion.unbind(-1)
    t = 2 / (quaternion * quaternion).sum(-1)
    rows = [
        1 - t * (y * y + z * z), t * (x * y - z * w), t * (x * z + y * w),
        t * (x * y + z * w), 1 - t * (x * x + z * z), t * (y * z - x * w),
        t * (x * z - y * w), t * (y * z + x * w), 1 - t * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*quaternion.shape[:-1], 3, 3)


def normalised_poses(world_from_camera: Tensor) -> Tensor:
    """What the camera encoder is given: `first_from_camera` [B, S, 4, 4] over the lower median distance (>= 0.1)."""
    first_from_world = inverse(world_from_camera[:, :1])
    relative = first_from_world @ world_from_camera
    distance = relative[..., :3, 3].norm(dim=-1)
    lower = (distance.shape[1] - 1) // 2
    median = distance.sort(dim=1).values[:, lower].clamp(min=0.1)
    scaled = relative.clone()
    scaled[..., :3, 3] /= median[:, None, None]
    return scaled


def pose_vector(first_from_camera: Tensor, focal: Tensor, height: int, width: int) -> Tensor:
    """[B, S, 9]: translation, xyzw, vertical and horizontal field of view (rad); `focal` [B, S, 2] is fx, fy (px)."""
    quaternion = quaternion_from_matrix(first_from_camera[..., :3, :3])
    fov = torch.stack([2 * torch.atan(0.5 * height / focal[..., 1]), 2 * torch.atan(0.5 * width / focal[..., 0])], -1)
    return torch.cat([first_from_camera[..., :3, 3], quaternion, fov], -1)


def rays_in_camera(focal: Tensor, height: int, width: int, rows: int, columns: int) -> Tensor:
    """Directions (z = 1) through the cell centres of a grid over the image: [B, S, rows, columns, 3]."""
    ys = (torch.arange(rows, dtype=focal.dtype, device=focal.device) + 0.5) * (height / rows) - 0.5 * height
    xs = (torch.arange(columns, dtype=focal.dtype, device=focal.device) + 0.5) * (width / columns) - 0.5 * width
    shape = (*focal.shape[:2], rows, columns)
    x = (xs / focal[..., None, None, 0]).expand(shape)
    y = (ys[:, None] / focal[..., None, None, 1]).expand(shape)
    return torch.stack([x, y, torch.ones_like(x)], -1)


def gauge(depth: Tensor, first_from_camera: Tensor, focal: Tensor) -> Tensor:
    """Mean distance [B] of all seen points from the first camera, m: the length that the network calls 1.

    `depth` [B, S, H, W], 0 where there is none.
    """
    height, width = depth.shape[-2:]
    # Every second pixel tells as much.
    some = depth[..., ::2, ::2]
    rays = rays_in_camera(focal, height, width, height, width)[..., ::2, ::2, :]
    points = rays * some[..., None]
    flat = points.flatten(2, 3) @ first_from_camera[..., :3, :3].transpose(-1, -2)
    flat = flat + first_from_camera[..., None, :3, 3]
    seen = (some > 0).flatten(2)
    distance = flat.norm(dim=-1) * seen
    return distance.sum((1, 2)) / seen.sum((1, 2)).clamp(min=1)


@torch.no_grad()
def matches(
    depth: Tensor, first_from_camera: Tensor, focal: Tensor, rows: int, columns: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Where each patch of each view is seen in each other view.

    depth [B, S, H, W] (0: none). Returns indices of the four patches round it [B, S, n, S, 4], their bilinear weights,
    and whether it is seen there at all [B, S, n, S] (inside, not hidden; never in its own view).
    """
    scenes, views, height, width = depth.shape
    side = height // rows
    # The pixel next to the middle of each patch stands for the patch.
    middle = depth[..., side // 2 :: side, side // 2 :: side]
    ys = torch.arange(rows, device=depth.device) * side + side // 2 + 0.5 - 0.5 * height
    xs = torch.arange(columns, device=depth.device) * side + side // 2 + 0.5 - 0.5 * width
    x = (xs / focal[..., None, None, 0]).expand_as(middle)
    y = (ys[:, None] / focal[..., None, None, 1]).expand_as(middle)
    points = (torch.stack([x, y, torch.ones_like(x)], -1) * middle[..., None]).flatten(2, 3)
    other_from_own = inverse(first_from_camera)[:, None] @ first_from_camera[:, :, None]
    there = torch.einsum("bijrc,bipc->bipjr", other_from_own[..., :3, :3], points)
    there = there + other_from_own[:, :, None, :, :3, 3]
    z = there[..., 2]
    pixel = there[..., :2] / z.clamp(min=1e-6)[..., None] * focal[:, None, None]
    u, v = pixel[..., 0] + 0.5 * width, pixel[..., 1] + 0.5 * height
    inside = (z > 1e-3) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    # What stands at that pixel, to tell what is hidden.
    flat = (v.clamp(0, height - 1).long() * width + u.clamp(0, width - 1).long()).permute(0, 3, 1, 2).flatten(2)
    stands = depth.flatten(2).gather(2, flat).unflatten(2, (views, rows * columns)).permute(0, 2, 3, 1)
    seen = inside & ((stands - z).abs() < 0.1 * z) & (middle.flatten(2) > 0)[..., None]
    seen &= ~torch.eye(views, dtype=torch.bool, device=depth.device)[:, None]
    column = ((u - side // 2 - 0.5) / side).clamp(0, columns - 1)
    row = ((v - side // 2 - 0.5) / side).clamp(0, rows - 1)
    left, above = column.floor().clamp(max=columns - 2), row.floor().clamp(max=rows - 2)
    a, b = column - left, row - above
    first = (above * columns + left).long()
    index = torch.stack([first, first + 1, first + columns, first + columns + 1], -1)
    weight = torch.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], -1)
    return index, weight, seen


def rotation_angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle between rotations [..., 3, 3], degrees."""
    trace = (a * b).sum((-1, -2))
    return torch.rad2deg(torch.acos(((trace - 1) / 2).clamp(-1, 1)))
