"""Changes of how pictures look, beyond what the rendered sensor does, so that colours and sharpness say little about
depth: a scene's views get the same ones, as one camera would.
"""

from __future__ import annotations

import math
import random

import torch
import torch.nn.functional as F
from torch import Tensor

from .data import MEAN, STD

GREY = torch.tensor([0.299, 0.587, 0.114]).view(3, 1, 1)
# Deviations: of the logarithms of a channel's gain, of the exponent, of a view's own brightness; of how channels mix.
GAIN, EXPONENT, EXPOSURE, MIXING = 0.08, 0.25, 0.08, 0.1


def varied(images: Tensor, share: float, rng: random.Random) -> Tensor:
    """Normalised pictures [B, S, 3, H, W] of which about a share of the scenes look different."""
    chosen = [b for b in range(len(images)) if rng.random() < share]
    if not chosen:
        return images
    mean, std = (t.to(images.device)[0] for t in (MEAN, STD))
    changed = images.clone()
    for b in chosen:
        changed[b] = (repainted(images[b] * std + mean, rng) - mean) / std
    return changed


def repainted(views: Tensor, rng: random.Random) -> Tensor:
    """[S, 3, H, W] in 0 to 1 as another camera would show them: sharpness, colours, tone, exposure."""
    views = refocused(views, rng)
    views = recoloured(views, rng).clamp(min=1e-3, max=1)
    views = views ** math.exp(rng.gauss(0, EXPONENT))
    exposure = torch.tensor([rng.gauss(0, EXPOSURE) for _ in views]).exp().view(-1, 1, 1, 1)
    return (views * exposure.to(views)).clamp(0, 1)


def refocused(views: Tensor, rng: random.Random) -> Tensor:
    """Sharpened in half of the cases, blurred in a sixth."""
    kind = rng.random()
    if kind > 2 / 3:
        return views
    wide = F.pad(views, (1, 1, 1, 1), mode="replicate")
    rows = wide[:, :, :-2] + 2 * wide[:, :, 1:-1] + wide[:, :, 2:]
    blurred = (rows[..., :-2] + 2 * rows[..., 1:-1] + rows[..., 2:]) / 16
    if kind < 1 / 6:
        return torch.lerp(views, blurred, rng.uniform(0.3, 1))
    return views + rng.uniform(0.3, 2.5) * (views - blurred)


def recoloured(views: Tensor, rng: random.Random) -> Tensor:
    """Other gains and mixtures of the channels, and colours from none to half as strong again."""
    grey = (views * GREY.to(views)).sum(1, keepdim=True)
    strength = 0.0 if rng.random() < 0.15 else rng.uniform(0.3, 1.5)
    views = torch.lerp(grey, views, strength)
    mix = torch.eye(3)
    if rng.random() < 0.5:
        mix = mix + torch.tensor([[rng.gauss(0, MIXING) for _ in range(3)] for _ in range(3)])
        mix = mix / mix.sum(1, keepdim=True)
    gains = torch.tensor([rng.gauss(0, GAIN) for _ in range(3)]).exp()
    return torch.einsum("dc,schw->sdhw", (gains[:, None] * mix).to(views), views)
