"""A Gaussian, for pictures and for depth."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def smooth(x: Tensor, sigma: float) -> Tensor:
    """[V, H, W] under a Gaussian of `sigma` pixels; the border is repeated."""
    reach = max(1, int(3 * sigma))
    kernel = torch.exp(-torch.arange(-reach, reach + 1.0).square() / (2 * sigma**2))
    kernel = (kernel / kernel.sum()).to(x)[None, None, None]
    x = F.conv2d(F.pad(x[:, None], (reach,) * 4, mode="replicate"), kernel)
    return F.conv2d(x, kernel.mT)[:, 0]
