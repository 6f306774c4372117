"""Changes of how pictures look, beyond what the rendered sensor does, so that colours and sharpness say little about
depth: a scene's views get the same ones, as one camera would. `photographed` is the pipeline of a small camera.
"""

from __future__ import annotations

import math
import random

import torch
import torch.nn.functional as F
from torch import Tensor

from .data import MEAN, STD
from .filters import smooth

GREY = torch.tensor([0.299, 0.587, 0.114]).view(3, 1, 1)
# Deviations: of the logarithms of a channel's gain, of the exponent, of a view's own brightness; of how channels mix.
GAIN, EXPONENT, EXPOSURE, MIXING = 0.08, 0.25, 0.08, 0.1
# Ranges of the camera's pipeline: blur of the lens (px), what the corners lose of their light, deviation of the noise
# that its filter left, and the step that JPEG rounds the mean of a block to, a share of white (quality 90 to 50 has
# 0.0016 to 0.008).
BLUR, SHADE, NOISE, STEP = (0.4, 1.3), (0.05, 0.5), (0.003, 0.02), (0.001, 0.01)
BLOCK = 8  # side of what JPEG transforms at once
LUMA = torch.tensor([[0.299, 0.587, 0.114], [-0.1687, -0.3313, 0.5], [0.5, -0.4187, -0.0813]])


def varied(images: Tensor, share: float, rng: random.Random) -> Tensor:
    """Normalised pictures [B, S, 3, H, W] of which about a share of the scenes look different."""
    chosen = [b for b in range(len(images)) if rng.random() < share]
    if not chosen:
        return images
    mean, std = (t.to(images.device)[0] for t in (MEAN, STD))
    changed = images.clone()
    for b in chosen:
        views = photographed(images[b] * std + mean, rng)
        changed[b] = (repainted(views, rng) - mean) / std
    return changed


def photographed(views: Tensor, rng: random.Random) -> Tensor:
    """[S, 3, H, W] in 0 to 1 through the pipeline of a small camera, each part in some of the cases: the lens blurs and
    gives the corners less light, the sensor's noise is smoothed, JPEG rounds."""
    if rng.random() < 0.4:
        views = blurred(views, rng.uniform(*BLUR))
    if rng.random() < 0.5:
        views = shaded(views, rng)
    if rng.random() < 0.5:
        generator = torch.Generator(views.device).manual_seed(rng.getrandbits(31))
        noise = torch.randn(views.shape, generator=generator, device=views.device)
        views = views + rng.uniform(*NOISE) * blurred(noise, 0.7) / 0.4  # 0.4: what the blur leaves of the deviation
    if rng.random() < 0.5:
        views = compressed(views, math.exp(rng.uniform(*map(math.log, STEP))))
    return views.clamp(0, 1)


def blurred(views: Tensor, sigma: float) -> Tensor:
    """[S, C, H, W] under a Gaussian of `sigma` pixels."""
    return smooth(views.flatten(0, 1), sigma).view_as(views)


def shaded(views: Tensor, rng: random.Random) -> Tensor:
    """Less light with the square of the distance from the centre, not quite alike in the three channels."""
    height, width = views.shape[-2:]
    y, x = (torch.linspace(-1, 1, n, device=views.device) for n in (height, width))
    square = (y[:, None] ** 2 + x**2) / 2
    loss = rng.uniform(*SHADE)
    channels = torch.tensor([loss * (1 + rng.uniform(-0.15, 0.15)) for _ in range(3)]).to(views)
    return views * (1 - channels[:, None, None] * square)


def compressed(views: Tensor, step: float) -> Tensor:
    """[S, 3, H, W] as JPEG leaves it: cosine transforms of blocks of luma and chroma, rounded more coarsely the finer
    the detail, chroma twice as coarsely."""
    height, width = views.shape[-2:]
    planes = torch.einsum("dc,schw->sdhw", LUMA.to(views), views)
    planes = F.pad(planes, (0, -width % BLOCK, 0, -height % BLOCK), mode="replicate")
    blocks = planes.unflatten(3, (-1, BLOCK)).unflatten(2, (-1, BLOCK)).transpose(3, 4)
    order = torch.arange(BLOCK, device=views.device)
    basis = ((order + 0.5) * order[:, None] * math.pi / BLOCK).cos() * (2 / BLOCK) ** 0.5
    basis[0] /= 2**0.5
    # The mean of a block is an eighth of its first coefficient; the finest detail is rounded six times as coarsely.
    steps = BLOCK * step * (1 + (order + order[:, None]) / 3) * torch.tensor([1.0, 2, 2]).to(views).view(3, 1, 1, 1, 1)
    found = ((basis @ blocks @ basis.T) / steps).round() * steps
    blocks = basis.T @ found @ basis
    planes = blocks.transpose(3, 4).flatten(2, 3).flatten(3)[..., :height, :width]
    return torch.einsum("dc,schw->sdhw", torch.linalg.inv(LUMA).to(views), planes)


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
