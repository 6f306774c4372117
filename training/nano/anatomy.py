"""Where the error of depth sits: which rooms, layout or detail, and what the tokens know of their patches.

    python -m nano.anatomy --model ../models/da3-nano --stream stream_views [--split val] [--rooms 24] [--size 280x182]

Scenes of 8 views, each after one scale (median ratio). Structure is parted by a Gaussian of the logarithm.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from .config import NATIVE, PATCH
from .data import scenes
from .evaluate import rendered
from .export import read
from .filters import smooth
from .metrics import depth_errors
from .model import Nano

VIEWS = 8
STEP = 0.3  # log-ratio of depth within a window about a patch wide from which it counts as a step
CELLS = 7  # a patch is compared as so many means a side


def cells(x: Tensor) -> Tensor:
    """[V, H, W] -> [patches, 7, 7] means, less the mean of the patch."""
    views, height, width = x.shape
    x = x.reshape(views, height // PATCH, PATCH, width // PATCH, PATCH).permute(0, 1, 3, 2, 4)
    x = F.avg_pool2d(x.reshape(-1, 1, PATCH, PATCH), PATCH // CELLS)[:, 0]
    return x - x.mean((1, 2), keepdim=True)


def beyond_plane(x: Tensor) -> Tensor:
    """What is left of `cells` after the best plane of each patch."""
    at = torch.arange(CELLS) - (CELLS - 1) / 2
    size = at.square().sum() * CELLS
    across, down = ((x * t).sum((1, 2), keepdim=True) / size for t in (at, at[:, None]))
    return x - across * at - down * at[:, None]


def near_a_step(log_depth: Tensor) -> Tensor:
    """Mask of the pixels with a step of depth around them."""
    x = log_depth[:, None]
    high, low = F.max_pool2d(x, PATCH + 1, 1, PATCH // 2), -F.max_pool2d(-x, PATCH + 1, 1, PATCH // 2)
    return (high - low)[:, 0] > STEP


def parts(found: Tensor, truth: Tensor) -> dict[str, float]:
    """Errors of one scene [V, H, W], and with part of the truth put in."""
    wrong, target = found.log(), truth.log()
    error = (found * (truth / found).median() - truth).abs() / truth
    step = near_a_step(target)
    row = {"all": depth_errors(found, truth)[0]}
    row["each view scaled"] = sum(depth_errors(f, t)[0] for f, t in zip(found, truth, strict=True)) / len(found)
    for sigma in (28, 14, 7):
        mixed = wrong - smooth(wrong, sigma) + smooth(target, sigma)
        row[f"true beyond {sigma} px"] = depth_errors(mixed.exp(), truth)[0]
    for sigma in (14, 7):
        mixed = target - smooth(target, sigma) + smooth(wrong, sigma)
        row[f"true below {sigma} px"] = depth_errors(mixed.exp(), truth)[0]
    row["near a step"] = error[step].mean().item() if step.any() else 0.0
    row["elsewhere"] = error[~step].mean().item()
    return row


def tokens_of(model: Nano, images: Tensor) -> list[Tensor]:
    """Patch tokens [patches, dim] of the embedding and after each block."""
    backbone, found = model.backbone["pretrained"], []
    views, width = images.shape[1], model.config.dim
    keep = lambda _module, _given, out: found.append(out.reshape(views, -1, width)[:, 1:].flatten(0, 1))  # noqa: E731
    hooks = [block.register_forward_hook(keep) for block in backbone.blocks]
    embedding = backbone.patch_embed(images[0]).flatten(0, 1)
    backbone(images, None, False)
    for hook in hooks:
        hook.remove()
    return [embedding, *found]


def read_linearly(tokens: Tensor, target: Tensor) -> float:
    """R2 of the best linear reading of `target` [patches, n], fitted on every other half of the patches."""
    known = torch.cat([tokens, torch.ones_like(tokens[:, :1])], 1).double()
    target, half = target.double(), len(tokens) // 2
    gram = known[:half].T @ known[:half]
    ridge = 1e-6 * gram.diagonal().mean() * torch.eye(len(gram), dtype=torch.float64)
    reading = torch.linalg.solve(gram + ridge, known[:half].T @ target[:half])
    left = target[half:] - known[half:] @ reading
    return 1 - (left.square().sum() / target[half:].square().sum()).item()


@torch.no_grad()
def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--stream", type=Path, required=True)
    parser.add_argument("--split", choices=["val", "test"], default="val")
    parser.add_argument("--rooms", type=int, default=24)
    parser.add_argument("--size", default=NATIVE)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    model = read(arguments.model)
    rows, detail, tokens, pictures = [], torch.zeros(2), [], []
    for clip in rendered(arguments.stream, arguments.split, arguments.rooms, VIEWS, arguments.size):
        batch = scenes([(clip, list(range(VIEWS)), False)])
        output = model(batch.images, None, wants_rays=False, select=True, autocast=True)
        found, truth = output.depth.float()[0], batch.depth[0]
        rows.append(parts(found, truth))
        known, true = (beyond_plane(cells(d.log())) for d in (found, truth))
        detail += torch.stack([(known - true).square().sum(), true.square().sum()])
        tokens.append(tokens_of(model, batch.images))
        pictures.append(cells(batch.images[0].mean(1)).flatten(1))
    errors = torch.tensor([row["all"] for row in rows])
    print(f"{len(rows)} rooms: mean {errors.mean():.3f}, standard error {errors.std() / len(rows) ** 0.5:.3f},")
    below, above = (errors < 0.1).float().mean(), (errors > 0.3).sum()
    print(f"median {errors.median():.3f}, below 0.10 {below:.2f}, above 0.3 {above}")
    for name in rows[0]:
        print(f"{name:20} {sum(row[name] for row in rows) / len(rows):.3f}")
    print(f"detail within patches beyond their planes, R2: {1 - (detail[0] / detail[1]).item():.3f}")
    for k, layer in enumerate(zip(*tokens, strict=True)):
        share = read_linearly(torch.cat(layer), torch.cat(pictures))
        print(f"{'embedding' if k == 0 else f'block {k - 1}':10} picture of its patch, R2: {share:.3f}")


if __name__ == "__main__":
    main()
