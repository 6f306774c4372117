"""Begins a run with the weights of an exported network, so that training can go on where only those are at hand.

    python -m nano.begin --model ../models/da3-nano --run RUN_FOLDER --step 16550

Step and room number are where the recipe goes on; the optimisers' memories and the average of the weights begin anew,
so let the next stage's rates rise from low ones.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from .data import normalise
from .export import read
from .model import Nano, enlarged
from .train import ROOT, Recipe, Trainer, sample_clips


def trained_grid(full: Tensor, rows: int) -> Tensor:
    """[1, dim, rows, rows] whose enlargement is nearest to `full` [1, dim, 37, 37]."""
    operator = enlarged(torch.eye(rows * rows).view(-1, 1, rows, rows)).flatten(1)
    found = torch.linalg.lstsq(operator.T.double(), full.flatten(2)[0].T.double()).solution
    return found.T.float().reshape(1, -1, rows, rows).contiguous()


def trainable(model: Nano) -> Nano:
    """A network that was read from a file, with a position grid that can be trained."""
    backbone = model.backbone["pretrained"]
    with torch.no_grad():
        backbone.pos_grid.copy_(trained_grid(backbone.full_grid(), model.config.trained_grid))
    backbone.pos_full = None
    return model


@torch.no_grad()
def widened(model: Nano, channels: tuple[int, int, int, int]) -> Nano:
    """The same network with as many or several times as many channels at each of the head's four levels; the new ones
    are projected from the features at random; the layers after them have weights of zero for them, so that the
    output is the same."""
    few = model.config.out_channels
    if any(b % a for a, b in zip(few, channels, strict=True)):
        raise ValueError(f"channels can stay or become several times as many: {few} cannot become {channels}")
    wide = Nano(replace(model.config, out_channels=channels))
    new = wide.state_dict()
    for name, old in model.state_dict().items():
        # Sines and cosines of the place are added to these channels: of twice as many every other one has an old rate,
        # of four times as many every fourth.
        kept = tuple(slice(None, None, b // a) for a, b in zip(old.shape, new[name].shape, strict=True))
        if name.startswith("head.resize_layers.") and old.dim() == 4:
            # What comes from new channels must not reach old ones; enlargements are stored as [from, to, ...].
            to = 1 if name.split(".")[2] in "01" else 0
            new[name].transpose(0, to)[kept[to]] = 0
        elif name.startswith("head.scratch."):
            new[name].zero_()
        new[name][kept] = old
    return wide


@torch.no_grad()
def tapped(model: Nano, layers: tuple[int, int, int, int], images: Tensor) -> Nano:
    """The same network with a head that reads other blocks: its projections are fitted to give what they
    gave before, by least squares over pictures [B, S, 3, H, W]."""
    other = Nano(replace(model.config, out_layers=layers))
    other.load_state_dict(model.state_dict())
    before, after = (
        [
            m.head.norm(patches).flatten(0, -2).double()
            for patches, _ in m.backbone["pretrained"](images, None, False)[0]
        ]
        for m in (model, other)
    )
    for k in range(len(layers)):
        if layers[k] == model.config.out_layers[k]:
            continue
        project = other.head.projects[k]
        target = before[k] @ project.weight.flatten(1).T.double() + project.bias
        known = torch.cat([after[k], torch.ones_like(after[k][:, :1])], 1)
        # Some features are the same twice over: of all answers the smallest.
        found = torch.linalg.lstsq(known, target, rcond=1e-4, driver="gelsd").solution
        project.weight.copy_(found[:-1].T.view_as(project.weight))
        project.bias.copy_(found[-1])
    return other


def numbers(text: str) -> tuple[int, int, int, int]:
    """Four of them, with commas between."""
    first, second, third, fourth = map(int, text.split(","))
    return first, second, third, fourth


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--recipe", type=Path, default=ROOT / "recipe.json")
    parser.add_argument("--stream", type=Path, default=ROOT.parent / "target/release/examples/stream_views")
    parser.add_argument("--step", type=int, required=True, help="steps that the weights have seen")
    parser.add_argument("--first-room", type=int, default=0, help="rooms of each process that they have seen")
    parser.add_argument("--out-layers", type=numbers, help="blocks that the head reads from now on: 1,7,9,11")
    parser.add_argument("--out-channels", type=numbers, help="channels of the head's levels from now on: 96,48,96,96")
    parser.add_argument("--views-seen", type=int, default=0)
    parser.add_argument("--distinct-views", type=int, default=0)
    parser.add_argument("--hours", type=float, default=0.0)
    arguments = parser.parse_args()
    if (arguments.run / "state.pt").exists():
        parser.error(f"{arguments.run} holds a run already; name another folder")
    arguments.run.mkdir(parents=True, exist_ok=True)
    model = trainable(read(arguments.model))
    if arguments.out_layers:
        clips = sample_clips(arguments.run, arguments.stream, "train", "112x70")
        images = torch.cat([normalise(clip.image[None]) for clip in clips])
        model = tapped(model, arguments.out_layers, images)
    if arguments.out_channels:
        model = widened(model, arguments.out_channels)
    trainer = Trainer(arguments.run, Recipe.read(arguments.recipe), arguments.stream, config=model.config)
    trainer.model.load_state_dict(model.state_dict())
    trainer.ema.load_state_dict(trainer.model.state_dict())
    trainer.step, trainer.room, trainer.seconds = arguments.step, arguments.first_room, 3600 * arguments.hours
    trainer.views_seen, trainer.distinct_views = arguments.views_seen, arguments.distinct_views
    trainer.save()
    print(f"{arguments.run}/state.pt goes on from step {arguments.step}")


if __name__ == "__main__":
    main()
