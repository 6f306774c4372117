"""Losses in the gauge of the network: depth, its gradient, rays, cameras; all weighted by the confidence they train."""

from __future__ import annotations

import torch
from torch import Tensor

from .data import Scenes
from .geometry import quaternion_from_matrix, rays_in_camera
from .model import Output

CONFIDENCE = 0.4  # weight of the logarithm that keeps the confidence from vanishing
GRADIENT = 0.5
ALIGNED = 0.5
RAYS = 1.0
CAMERA = 1.0
SMALL = 0.03


def masked_mean(value: Tensor, mask: Tensor) -> Tensor:
    """Mean over the mask."""
    return (value * mask).sum() / mask.sum().clamp(min=1)


def confident(error: Tensor, confidence: Tensor, mask: Tensor) -> Tensor:
    """Mean of c e - a log c."""
    return masked_mean(confidence * error - CONFIDENCE * confidence.log(), mask)


def depth_terms(output: Output, scenes: Scenes) -> dict[str, Tensor]:
    """Relative errors (of the logarithm) of depth and of its differences between neighbouring pixels."""
    mask = scenes.depth > 0
    target = scenes.depth.clamp(min=1e-4).log()
    wrong = output.log_depth - target
    count = mask.sum((1, 2, 3), keepdim=True).clamp(min=1)
    offset = (wrong * mask).sum((1, 2, 3), keepdim=True) / count
    both_x, both_y = mask[..., 1:] & mask[..., :-1], mask[..., 1:, :] & mask[..., :-1, :]
    gradient = masked_mean((wrong[..., 1:] - wrong[..., :-1]).abs(), both_x) + masked_mean(
        (wrong[..., 1:, :] - wrong[..., :-1, :]).abs(), both_y
    )
    return {
        "depth": confident(wrong.abs(), output.depth_conf, mask),
        "aligned": masked_mean((wrong - offset).abs(), mask),
        "gradient": gradient,
    }


def ray_term(output: Output, scenes: Scenes) -> Tensor:
    """Directions and origins of rays in the first camera's frame."""
    height, width = scenes.depth.shape[-2:]
    rows, columns = output.ray.shape[-2:]
    rays = rays_in_camera(scenes.focal, height, width, rows, columns)
    turned = rays.flatten(2, 3) @ scenes.first_from_camera[..., :3, :3].transpose(-1, -2)
    direction = turned.unflatten(2, (rows, columns)).permute(0, 1, 4, 2, 3)
    origin = scenes.first_from_camera[..., :3, 3, None, None].expand_as(direction)
    error = (output.ray - torch.cat([direction, origin], 2)).abs().mean(2)
    return confident(error, output.ray_conf, torch.ones_like(error))


def camera_terms(output: Output, scenes: Scenes) -> dict[str, Tensor]:
    """Lengths of the errors of translation, quaternion and fields of view."""
    height, width = scenes.depth.shape[-2:]
    found = output.pose_enc
    quaternion = quaternion_from_matrix(scenes.first_from_camera[..., :3, :3])
    size = torch.tensor([height, width], dtype=torch.float32)
    fov = 2 * torch.atan(0.5 * size / scenes.focal.flip(-1))
    # Smooth near zero: errors below SMALL need not pull as hard as large ones.
    length = lambda v: ((v.square().sum(-1) + SMALL**2).sqrt() - SMALL).mean()  # noqa: E731
    return {
        "t": length(found[..., :3] - scenes.first_from_camera[..., :3, 3]),
        "q": length(found[..., 3:7] - quaternion),
        "fov": length(found[..., 7:] - fov),
    }


def total(output: Output, scenes: Scenes) -> tuple[Tensor, dict[str, float]]:
    """The sum that is minimised, and its terms."""
    terms = depth_terms(output, scenes)
    loss = terms["depth"] + ALIGNED * terms["aligned"] + GRADIENT * terms["gradient"]
    if output.ray is not None:
        terms["ray"] = ray_term(output, scenes)
        loss = loss + RAYS * terms["ray"]
    cameras = camera_terms(output, scenes)
    terms.update(cameras)
    loss = loss + CAMERA * (cameras["t"] + 3 * cameras["q"] + 0.5 * cameras["fov"])
    return loss, {name: term.item() for name, term in terms.items()}
