"""Begins a run with the weights of an exported network, so that training can go on where only those are at hand.

    python -m nano.begin --model ../models/da3-nano --run RUN_FOLDER --step 16550

Step and room number are where the recipe goes on; the optimisers' memories and the average of the weights begin anew,
so let the next stage's rates rise from low ones.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torch import Tensor

from .export import read
from .model import Nano, enlarged
from .train import ROOT, Recipe, Trainer


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


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--recipe", type=Path, default=ROOT / "recipe.json")
    parser.add_argument("--stream", type=Path, default=ROOT.parent / "target/release/examples/stream_views")
    parser.add_argument("--step", type=int, required=True, help="steps that the weights have seen")
    parser.add_argument("--first-room", type=int, default=0, help="rooms of each process that they have seen")
    parser.add_argument("--views-seen", type=int, default=0)
    parser.add_argument("--distinct-views", type=int, default=0)
    parser.add_argument("--hours", type=float, default=0.0)
    arguments = parser.parse_args()
    if (arguments.run / "state.pt").exists():
        parser.error(f"{arguments.run} holds a run already; name another folder")
    arguments.run.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(arguments.run, Recipe.read(arguments.recipe), arguments.stream)
    trainer.model.load_state_dict(trainable(read(arguments.model)).state_dict())
    trainer.ema.load_state_dict(trainer.model.state_dict())
    trainer.step, trainer.room, trainer.seconds = arguments.step, arguments.first_room, 3600 * arguments.hours
    trainer.views_seen, trainer.distinct_views = arguments.views_seen, arguments.distinct_views
    trainer.save()
    print(f"{arguments.run}/state.pt goes on from step {arguments.step}")


if __name__ == "__main__":
    main()
