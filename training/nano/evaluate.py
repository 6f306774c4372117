"""Errors on rooms that were never trained on and on real frames, beside a constant depth.

    python -m nano.evaluate --model ../models/da3-nano --stream stream_views [--rooms 40] [--size 280x182]
                            [--soften 0.5] [--real SHARED_DATA_FOLDER] [--out table.md]

Depth is compared after one scale per scene (median ratio); poses by relative rotation and direction of the baseline
over all pairs of views. `by poses` is the depth after the scale that the given camera centres imply. `--soften` blurs
what the network sees.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from .config import NATIVE
from .data import Clip, clips_of, scenes
from .export import read, trained
from .filters import smooth
from .metrics import Tally, add_scenes
from .model import Nano
from .real import real_clips

COLUMNS = {
    "abs_rel": "AbsRel",
    "delta125": "δ<1.25",
    "abs_rel_by_poses": "AbsRel by poses",
    "rotation_deg": "rotation °",
    "direction_deg": "direction °",
    "constant_abs_rel": "constant AbsRel",
    "constant_delta125": "constant δ<1.25",
}


def rendered(stream: Path, split: str, rooms: int, views: int, size: str) -> list[Clip]:
    """One clip of each of `rooms` rooms; rooms of the validation split from 1000 on were never looked at."""
    with tempfile.NamedTemporaryFile(suffix=".bin") as file:
        arguments = ["--split", split, "--rooms", str(rooms), "--clips", "1", "--views", str(views), "--sizes", size]
        subprocess.run([str(stream), *arguments], stdout=file, check=True)
        return clips_of(Path(file.name))


def softened(clip: Clip, sigma: float) -> Clip:
    """The clip as it looks under a Gaussian of `sigma` pixels."""
    if sigma <= 0:
        return clip
    channels = torch.from_numpy(np.array(clip.image)).float().movedim(-1, 0)
    image = torch.stack([smooth(c, sigma) for c in channels], -1)
    return replace(clip, image=image.round().byte().numpy())


def errors(model: Nano, clips: list[Clip], views: int, posed: bool, autocast: bool) -> dict[str, float]:
    """The row of a table: `views` of each clip, spread over it."""
    tally = Tally()
    for clip in clips:
        chosen = list(range(0, len(clip.image), len(clip.image) // views))[:views]
        add_scenes(tally, model, scenes([(clip, chosen, False)]), posed, autocast)
    return tally.row()


def table(model: Nano, places: dict[str, dict[int, list[Clip]]], autocast: bool) -> str:
    """Markdown."""
    lines = ["| data | views | cameras | " + " | ".join(COLUMNS.values()) + " |"]
    lines.append("|---|---:|---|" + "---:|" * len(COLUMNS))
    for place, by_views in places.items():
        for views, clips in by_views.items():
            for posed in (False, True):
                row = errors(model, clips, views, posed, autocast)
                values = " | ".join(f"{row[name]:.3f}" if "deg" not in name else f"{row[name]:.1f}" for name in COLUMNS)
                cameras = "given" if posed else "free"
                lines.append(f"| {place} ({len(clips)}) | {views} | {cameras} | {values} |".replace("nan", "–"))
                print(lines[-1], flush=True)
    return "\n".join(lines) + "\n"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--model", type=Path)
    source.add_argument("--run", type=Path)
    parser.add_argument("--stream", type=Path, required=True)
    parser.add_argument("--split", choices=["val", "test"], default="test")
    parser.add_argument("--rooms", type=int, default=40)
    parser.add_argument("--size", default=NATIVE)
    parser.add_argument("--real", type=Path)
    parser.add_argument("--soften", type=float, default=0.0, help="deviation of a Gaussian, pixels")
    parser.add_argument("--exact", action="store_true", help="f32 throughout")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    model = read(arguments.model) if arguments.model else trained(arguments.run, "ema")[0]
    width, height = map(int, arguments.size.split("x"))
    clips = rendered(arguments.stream, arguments.split, arguments.rooms, 16, arguments.size)
    clips = [softened(clip, arguments.soften) for clip in clips]
    short = [replace(c, image=c.image[:8], depth=c.depth[:8], world_from_camera=c.world_from_camera[:8]) for c in clips]
    places = {f"rendered {arguments.split} rooms": {1: short, 4: short, 8: short, 16: clips}}
    if arguments.real:
        for views in (1, 4, 8, 16):
            for name, found in real_clips(arguments.real, (height, width), max(views, 4)).items():
                places.setdefault(name, {})[views] = [softened(clip, arguments.soften) for clip in found]
    text = table(model, places, not arguments.exact)
    if arguments.out:
        arguments.out.write_text(text)


if __name__ == "__main__":
    main()
