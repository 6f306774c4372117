"""Losses in the gauge of the network: depth, its gradient, rays, cameras, weighted by the confidence they train.

Two more than the paper has, because from so few pictures correspondence does not emerge by itself (after 92 000 views
without them rotations were those of a constant): some heads of some global blocks are told which patches see the same
place, and a linear map that is not kept reads from the patches half-way how far they moved since the first view.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from .config import PATCH
from .data import Scenes
from .geometry import matches, quaternion_from_matrix, rays_in_camera
from .model import Output

CONFIDENCE = 0.4  # weight of the logarithm that keeps the confidence from vanishing
# Confidence weighs pixels by one over their error: alone it teaches most where little is left to learn, so that edges
# and rooms that are hard would hardly count. The relative error, which is what depth is judged by, leads instead.
DEPTH = 0.4
ALIGNED = 4.0
GRADIENT = 2.0
# Differences over several distances (pixels): those over one pixel alone cost least where an edge is not drawn at all,
# and errors of whole surfaces hide what the other terms would say about detail.
DISTANCES = (1, 4, 12)
RAYS = 1.0
CAMERA = 1.0
MATCH = 0.1
MOVED = 2.0
SMALL = 0.03
STEEP = 1.0  # log-ratio from which a relative error grows linearly in it
# (block, head) that learn where a patch is in every other view, and where it is in the first one.
PAIR_HEADS = ((3, 0), (5, 0))
FIRST_HEADS = ((5, 1), (7, 1))
WATCHED = tuple(sorted({block for block, _ in PAIR_HEADS + FIRST_HEADS}))


def masked_mean(value: Tensor, mask: Tensor) -> Tensor:
    """Mean over the mask."""
    return (value * mask).sum() / mask.sum().clamp(min=1)


def confident(error: Tensor, confidence: Tensor, mask: Tensor) -> Tensor:
    """Mean of c e - a log c."""
    return masked_mean(confidence * error - CONFIDENCE * confidence.log(), mask)


def middle(value: Tensor, mask: Tensor) -> Tensor:
    """Median of each scene over the mask, B x 1 x 1 x 1."""
    flat = value.masked_fill(~mask, float("nan")).flatten(1)
    return flat.nanmedian(1).values.nan_to_num()[:, None, None, None]


def relative(log_ratio: Tensor) -> Tensor:
    """What depth is wrong by, as a share of the truth, from the logarithm of their ratio; linear once far too deep."""
    gentle = log_ratio.clamp(max=STEEP)
    return gentle.expm1().abs() + math.exp(STEEP) * (log_ratio - gentle)


def depth_terms(output: Output, scenes: Scenes) -> dict[str, Tensor]:
    """Errors of the logarithm of depth and of its differences between pixels near each other, and the relative error
    that is left after one scale per scene, which is what depth is judged by: near surfaces seen too far cost more."""
    mask = scenes.depth > 0
    target = scenes.depth.clamp(min=1e-4).log()
    wrong = output.log_depth - target
    count = mask.sum((1, 2, 3), keepdim=True).clamp(min=1)
    mean = (wrong * mask).sum((1, 2, 3), keepdim=True) / count
    # The scale is the median's; its gradient is spread over all pixels, so that this term does not pull at the scale.
    offset = middle(wrong.detach(), mask) + mean - mean.detach()
    gradient = sum(differences(wrong, mask, distance) for distance in DISTANCES) / len(DISTANCES)
    return {
        "depth": confident(wrong.abs(), output.depth_conf, mask),
        "aligned": masked_mean(relative(wrong - offset), mask),
        "gradient": gradient,
    }


def differences(wrong: Tensor, mask: Tensor, distance: int) -> Tensor:
    """Mean size of the differences of [B, S, H, W] between pixels so far apart in a row, and in a column."""
    found = wrong.new_zeros(())
    for axis in (2, 3):
        length = wrong.shape[axis] - distance
        a, b = wrong.narrow(axis, 0, length), wrong.narrow(axis, distance, length)
        both = mask.narrow(axis, 0, length) & mask.narrow(axis, distance, length)
        found = found + masked_mean((a - b).abs(), both)
    return found


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
    size = torch.tensor([height, width], dtype=torch.float32, device=found.device)
    fov = 2 * torch.atan(0.5 * size / scenes.focal.flip(-1))
    # Smooth near zero: errors below SMALL need not pull as hard as large ones.
    length = lambda v: ((v.square().sum(-1) + SMALL**2).sqrt() - SMALL).mean()  # noqa: E731
    return {
        "t": length(found[..., :3] - scenes.first_from_camera[..., :3, 3]),
        "q": length(found[..., 3:7] - quaternion),
        "fov": length(found[..., 7:] - fov),
    }


def match_terms(output: Output, scenes: Scenes, reader: nn.Module | None = None) -> dict[str, Tensor]:
    """Cross-entropy, less that of the truth, between attention and the patches that see the same place.

    `pair` compares within each other view, whatever attention the views get; `first` over all tokens of the scene;
    `moved` is how wrong `reader` is about the way to the first view, in widths of the image.
    """
    some = next(iter(output.logits.values()))
    views, (height, width) = scenes.depth.shape[1], scenes.depth.shape[-2:]
    rows, columns = height // PATCH, width // PATCH
    index, weight, seen = matches(scenes.depth, scenes.first_from_camera, scenes.focal, rows, columns)
    entropy = -(weight * weight.clamp(min=1e-9).log()).sum(-1)
    pair, first = some.new_zeros((), dtype=torch.float32), some.new_zeros((), dtype=torch.float32)
    split = (views, rows * columns + 1)
    for block, head in PAIR_HEADS:
        logits = output.logits[block][:, head].unflatten(2, split).unflatten(1, split)[:, :, 1:, :, 1:]
        found = (weight * logits.float().log_softmax(-1).gather(-1, index)).sum(-1)
        pair = pair + masked_mean(-found - entropy, seen)
    index, weight, seen, entropy = index[..., 0, :], weight[..., 0, :], seen[..., 0], entropy[..., 0]
    for block, head in FIRST_HEADS:
        share = output.logits[block][:, head].float().log_softmax(-1).unflatten(2, split).unflatten(1, split)
        found = (weight * share[:, :, 1:, 0, 1:].gather(-1, index)).sum(-1)
        first = first + masked_mean(-found - entropy, seen)
    terms = {"pair": pair / len(PAIR_HEADS), "first": first / len(FIRST_HEADS)}
    if reader is not None and output.patches is not None:
        own = torch.arange(rows * columns, device=some.device)
        there = torch.stack([(weight * (index % columns)).sum(-1), (weight * (index // columns)).sum(-1)], -1)
        way = (there - torch.stack([own % columns, own // columns], -1)) / columns
        terms["moved"] = masked_mean((reader(output.patches.float()) - way).norm(dim=-1), seen)
    return terms


def total(
    output: Output, scenes: Scenes, reader: nn.Module | None = None, match: float = 1.0, depth: float = 1.0
) -> tuple[Tensor, dict[str, float]]:
    """The sum that is minimised, and its terms; `match` and `depth` are factors on correspondence and on depth."""
    terms = depth_terms(output, scenes)
    loss = depth * (DEPTH * terms["depth"] + ALIGNED * terms["aligned"] + GRADIENT * terms["gradient"])
    if output.ray is not None:
        terms["ray"] = ray_term(output, scenes)
        loss = loss + RAYS * terms["ray"]
    if output.logits and scenes.depth.shape[1] > 1:
        found = match_terms(output, scenes, reader)
        terms.update(found)
        loss = loss + match * (MATCH * (found["pair"] + found["first"]) + MOVED * found.get("moved", 0.0))
    cameras = camera_terms(output, scenes)
    terms.update(cameras)
    loss = loss + CAMERA * (cameras["t"] + 3 * cameras["q"] + 0.5 * cameras["fov"])
    return loss, {name: term.item() for name, term in terms.items()}
