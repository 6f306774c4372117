"""Momentum with orthogonalised steps for hidden matrices and convolutions, Adam with decoupled decay for the rest."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

LAST_ROWS = 7  # rows of the largest of the head's last convolutions (a ray and its confidence)


def orthogonalised(matrix: Tensor, steps: int = 5) -> Tensor:
    """About the nearest matrix with orthonormal rows or columns, by a quintic Newton-Schulz iteration (Jordan 2024).

    [k, rows, columns] or [rows, columns]; in bf16, which is exact enough for a direction.
    """
    a, b, c = 3.4445, -4.7750, 2.0315
    tall = matrix.shape[-2] > matrix.shape[-1]
    x = matrix.bfloat16()
    if tall:
        x = x.mT.contiguous()
    x = x / (x.norm(dim=(-2, -1), keepdim=True) + 1e-7)
    for _ in range(steps):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return (x.mT if tall else x).float()


class Muon(torch.optim.Optimizer):
    """Nesterov momentum whose step is orthogonalised; joint projections (`attn.qkv`) are treated as three matrices."""

    def __init__(self, params: list[nn.Parameter], lr: float, momentum: float = 0.95, decay: float = 0.01) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum, "decay": decay})
        # Several processes that hold the same gradients share the work: each makes some of the directions.
        self.rank, self.processes = 0, 1
        self.shared: Tensor | None = None
        self.wait: Callable[[], object] = lambda: None

    def divide(self, rank: int, processes: int, shared: Tensor, wait: Callable[[], object]) -> None:
        """From now on process `rank` makes every `processes`-th direction; `shared` has room for all our numbers."""
        self.rank, self.processes, self.shared, self.wait = rank, processes, shared, wait

    @torch.no_grad()
    def step(self, closure: None = None) -> None:
        """One step."""
        for group in self.param_groups:
            used = [p for p in group["params"] if p.grad is not None]
            directions = {}
            at = 0
            for k, p in enumerate(used):
                buffer = self.state[p].setdefault("momentum", torch.zeros_like(p))
                buffer.lerp_(p.grad, 1 - group["momentum"])
                parts = self.parts(p)
                directions[p] = p.grad
                if self.shared is not None:
                    directions[p] = self.shared[at : at + p.numel()].view_as(p)
                    at += p.numel()
                # Four matrices make a block.
                if k // 4 % self.processes == self.rank:
                    step = p.grad.lerp(buffer, group["momentum"])
                    # A convolution is the matrix of its unrolled windows.
                    found = orthogonalised(step.reshape(parts, p.shape[0] // parts, -1)).reshape(p.shape)
                    directions[p].copy_(found)
            self.wait()
            for p in used:
                rows, columns = p.shape[0] // self.parts(p), p[0].numel()
                p.mul_(1 - group["lr"] * group["decay"])
                p.add_(directions[p], alpha=-group["lr"] * max(1.0, rows / columns) ** 0.5)
            self.wait()

    @staticmethod
    def parts(p: nn.Parameter) -> int:
        """Matrices that a parameter holds."""
        return 3 if p.dim() == 2 and p.shape[0] == 3 * p.shape[1] else 1


def optimisers(model: nn.Module, muon_lr: float, adam_lr: float) -> list[torch.optim.Optimizer]:
    """The two optimisers of a network."""
    hidden, rest, plain = [], [], []
    for name, p in model.named_parameters():
        in_blocks = ".blocks." in name or ".trunk." in name
        # The head's convolutions but for the last ones, whose few rows are the answers themselves.
        in_head = name.startswith("head.") and p.dim() == 4 and p.shape[0] > LAST_ROWS
        if in_blocks and p.dim() == 2 or in_head:
            hidden.append(p)
        elif p.dim() >= 2 and name.endswith("weight"):
            rest.append(p)
        else:
            plain.append(p)
    groups = [{"params": rest, "weight_decay": 0.01}, {"params": plain, "weight_decay": 0.0}]
    groups[0]["share"] = 1.0
    # Biases and gains see the same gradient step after step: at the full rate they would outgrow the signal.
    groups[1]["share"] = 0.25
    adam = torch.optim.AdamW(groups, lr=adam_lr, betas=(0.9, 0.98), eps=1e-9, fused=True)
    return [Muon(hidden, muon_lr), adam]
