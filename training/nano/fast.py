"""Operations whose usual backward pass is slow on a CPU in 16 bits: together they took a fifth of a training step."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional


class Relu(torch.autograd.Function):
    """As `functional.relu`; backward a product with the sign, ten times as fast as a comparison."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = functional.relu(x)
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return y.sign().mul_(gradient)


class FewOutputs(torch.autograd.Function):
    """A linear map [n, inputs] -> [n, outputs] to a handful of numbers; backward a sum of outer products."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return functional.linear(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, weight = ctx.saved_tensors
        gradient, rows = gradient.to(x.dtype), weight.to(x.dtype)
        to_x = gradient[:, :1] * rows[0]
        for k in range(1, len(rows)):
            to_x.addcmul_(gradient[:, k : k + 1], rows[k])
        to_weight = gradient.T @ x
        return to_x, to_weight.to(weight.dtype), gradient.float().sum(0).to(weight.dtype)


def relu(x: Tensor) -> Tensor:
    """max(x, 0)."""
    return Relu.apply(x)


def pointwise(x: Tensor, conv: nn.Conv2d) -> Tensor:
    """The 1 x 1 convolution `conv` of [V, C, h, w]."""
    flat, weight = x.permute(0, 2, 3, 1), conv.weight.flatten(1)
    if len(weight) > 2:
        found = functional.linear(flat, weight, conv.bias)
    else:
        found = FewOutputs.apply(flat.flatten(0, 2), weight, conv.bias).unflatten(0, flat.shape[:3])
    return found.permute(0, 3, 1, 2)
