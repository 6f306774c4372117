"""How well scenes are understood: depth after one scale per scene, relative poses, with and without given cameras."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from .data import Scenes
from .geometry import homogeneous, inverse, rotation_angle
from .model import Nano

SHORTEST_BASELINE_M = 0.05  # pairs of views closer than this have no direction to speak of


@dataclass
class Tally:
    """Errors of many scenes; `row` reduces them."""

    abs_rel: list[float] = field(default_factory=list)
    within: list[float] = field(default_factory=list)
    posed_abs_rel: list[float] = field(default_factory=list)
    rotation: list[Tensor] = field(default_factory=list)
    direction: list[Tensor] = field(default_factory=list)
    constant: list[float] = field(default_factory=list)
    constant_within: list[float] = field(default_factory=list)

    def row(self) -> dict[str, float]:
        """Means of depth errors after alignment, medians of errors by poses and of poses (degrees)."""

        def median(parts: list[Tensor]) -> float:
            joined = torch.cat(parts) if parts else torch.zeros(0)
            return joined.median().item() if len(joined) else float("nan")

        def mean(values: list[float]) -> float:
            return sum(values) / len(values) if values else float("nan")

        return {
            "abs_rel": mean(self.abs_rel),
            "delta125": mean(self.within),
            # A scene whose centres all fall on one place has no scale at all: one such would spoil a mean.
            "abs_rel_by_poses": median([torch.tensor(self.posed_abs_rel)]),
            "rotation_deg": median(self.rotation),
            "direction_deg": median(self.direction),
            "constant_abs_rel": mean(self.constant),
            "constant_delta125": mean(self.constant_within),
        }


def depth_errors(found: Tensor, truth: Tensor, scale: Tensor | None = None) -> tuple[float, float]:
    """AbsRel and share within a factor of 1.25 of one scene, after the median ratio unless a scale is given."""
    mask = truth > 0
    found, truth = found[mask], truth[mask]
    ratio = (truth / found).median() if scale is None else scale
    found = found * ratio
    relative = ((found - truth).abs() / truth).mean().item()
    worst = torch.maximum(found / truth, truth / found)
    return relative, (worst < 1.25).float().mean().item()


def pair_errors(found: Tensor, truth: Tensor, scale_m: float) -> tuple[Tensor, Tensor]:
    """Angles (degrees) of relative rotations and of directions of baselines, over all pairs of views [S, 4, 4]."""
    first, second = torch.triu_indices(len(found), len(found), 1)
    relative = [inverse(p[first]) @ p[second] for p in (found, truth)]
    rotation = rotation_angle(relative[0][:, :3, :3], relative[1][:, :3, :3])
    a, b = (r[:, :3, 3] for r in relative)
    long = b.norm(dim=-1) * scale_m > SHORTEST_BASELINE_M
    cosine = torch.nn.functional.cosine_similarity(a[long], b[long], dim=-1)
    return rotation, torch.rad2deg(torch.acos(cosine.clamp(-1, 1)))


def scale_from_poses(found: Tensor, truth: Tensor) -> Tensor:
    """Factor by which found camera centres are multiplied to fit true ones [S, 4, 4], after a similarity's best fit."""
    p, g = found[:, :3, 3], truth[:, :3, 3]
    p, g = p - p.mean(0), g - g.mean(0)
    u, d, vt = torch.linalg.svd((p.T @ g).double())
    sign = torch.ones(3, dtype=torch.float64)
    sign[2] = torch.sign(torch.det(u) * torch.det(vt))
    # As inference does: the found ones are explained by the given ones, and the factor inverted.
    return (g.square().sum() / (d * sign).sum().clamp(min=1e-12)).float()


@torch.no_grad()
def add_scenes(tally: Tally, model: Nano, scenes: Scenes, posed: bool, autocast: bool = True) -> None:
    """Runs the network as inference does and adds its errors."""
    device = next(model.parameters()).device
    output = model(
        scenes.images.to(device),
        scenes.pose9.to(device) if posed else None,
        wants_rays=False,
        select=True,
        autocast=autocast,
    )
    found = homogeneous(output.world_from_camera().float()).cpu()
    depth = output.depth.float().cpu()
    for b in range(found.shape[0]):
        truth = scenes.depth[b]
        relative, within = depth_errors(depth[b], truth)
        tally.abs_rel.append(relative)
        tally.within.append(within)
        flat = torch.full_like(truth, 1.0)
        relative, within = depth_errors(flat, truth)
        tally.constant.append(relative)
        tally.constant_within.append(within)
        if found.shape[1] >= 2:
            rotation, direction = pair_errors(found[b], scenes.first_from_camera[b], scenes.scale[b].item())
            tally.rotation.append(rotation)
            tally.direction.append(direction)
        if found.shape[1] >= 3:
            scale = scale_from_poses(found[b], scenes.first_from_camera[b])
            tally.posed_abs_rel.append(depth_errors(depth[b], truth, scale)[0])
