"""Trains the network on endless rendered rooms; stops and goes on at any time.

    python -m nano.train --run RUN_FOLDER [--recipe recipe.json] [--stream stream_views]
                         [--processes 2] [--threads 1] [--renderers 1] [--device cpu]

On a CPU let every core have a process of one thread: each works on scenes and with a renderer of its own, and gradients
are averaged in shared memory. On a graphics processor one process with a renderer on every other core is enough:
`--device cuda --renderers 15`.

`RUN_FOLDER/state.pt` holds everything that is needed to go on and is replaced every few minutes, and on SIGTERM, which
ends training after the step under way; `train.csv` and
`validation.csv` grow. The recipe is read at every start, so a later session can add stages.
"""

from __future__ import annotations

import argparse
import copy
import csv
import json
import os
import random
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.multiprocessing as multiprocessing
from torch import Tensor, nn

from .augment import varied
from .config import NATIVE, NanoConfig, from_dict
from .data import ROOMS_APART, Clip, Pool, Renderer, Scenes, clips_of, normalise, scenes
from .losses import WATCHED, total
from .metrics import Tally, add_scenes
from .model import Nano, whiten_patches
from .optim import optimisers

ROOT = Path(__file__).resolve().parents[1]
MOST_CLIPS = 24  # that a process takes scenes from in one step


@dataclass
class Stage:
    """Part of the recipe: until which step, which sizes (`stream_views --sizes`), how many views a step, and how often
    a scene has how many of them, which share of the rooms are homes (`stream_views --home-share`), how strongly
    correspondence and depth are taught, and which share of the scenes look different (`augment.varied`)."""

    until_step: int
    sizes: str
    views_per_step: int
    views_per_clip: int = 8
    lr_from: float = 1.0
    lr_to: float = 1.0
    scene_views: str = "1:4,2:30,3:10,4:26,6:6,8:24,16:20"
    home_share: float = 0.0
    match: float = 1.0
    depth: float = 1.0
    augmented: float = 0.0

    def weighted_sizes(self) -> dict[tuple[int, int], int]:
        """Weight of each (height, width)."""
        found = {}
        for part in self.sizes.split(","):
            size, _, weight = part.partition(":")
            width, height = map(int, size.split("x"))
            found[height, width] = int(weight or 1)
        return found


@dataclass
class Recipe:
    """How training goes; see `recipe.json`."""

    muon_lr: float
    adam_lr: float
    warmup_steps: int
    ema_decay: float
    posed_share: float
    ray_share: float
    clips_per_room: int
    clip_uses: int
    stages: list[Stage]

    @staticmethod
    def read(path: Path) -> Recipe:
        """From JSON."""
        raw = json.loads(path.read_text())
        stages = [Stage(**s) for s in raw.pop("stages")]
        return Recipe(**raw, stages=stages)

    def stage(self, step: int) -> tuple[int, Stage] | None:
        """The stage of a step and where it begins; None after the last."""
        begin = 0
        for stage in self.stages:
            if step < stage.until_step:
                return begin, stage
            begin = stage.until_step
        return None

    def lr_factor(self, step: int) -> float:
        """Warm-up, then linear within each stage."""
        begin, stage = self.stage(step) or (0, self.stages[-1])
        share = (step - begin) / max(1, stage.until_step - begin)
        return min(1.0, (step + 1) / self.warmup_steps) * (stage.lr_from + (stage.lr_to - stage.lr_from) * share)


class Team:
    """Processes that average what they found; each is as far as every other."""

    def __init__(self, processes: int, numbers: int) -> None:
        self.processes = processes
        # The last number of each row asks to stop.
        self.rows = torch.zeros(processes, numbers + 1).share_memory_()
        self.directions = torch.zeros(numbers).share_memory_()
        self.barrier = multiprocessing.get_context("spawn").Barrier(processes, timeout=3600)

    def average(self, rank: int, parameters: list[Tensor], stopping: bool) -> bool:
        """Replaces gradients by their mean over all processes; whether any of them wants to stop."""
        if self.processes == 1:
            return stopping
        row, at = self.rows[rank], 0
        for p in parameters:
            own = row[at : at + p.numel()]
            own.zero_() if p.grad is None else own.copy_(p.grad.flatten())
            at += p.numel()
        row[-1] = stopping
        self.barrier.wait()
        mean, at = self.rows.mean(0), 0
        self.barrier.wait()
        for p in parameters:
            own = mean[at : at + p.numel()]
            # What no process used stays as if it were not there.
            p.grad = own.view_as(p).to(p.device) if p.grad is not None or own.any() else None
            at += p.numel()
        return bool(mean[-1] > 0)


class Trainer:
    """Model, optimisers, averages and where training stands; one per process."""

    def __init__(
        self,
        run: Path,
        recipe: Recipe,
        stream: Path,
        device: str = "cpu",
        rank: int = 0,
        config: NanoConfig | None = None,
        renderers: int = 1,
    ) -> None:
        self.run, self.recipe, self.stream, self.device, self.rank = run, recipe, stream, device, rank
        self.renderers = renderers
        self.step, self.room, self.seconds, self.views_seen = 0, 0, 0.0, 0
        self.distinct_views = 0
        saved = run / "state.pt"
        state = torch.load(saved, map_location="cpu", weights_only=True) if saved.exists() else None
        self.config = from_dict(state["config"]) if state else config or NanoConfig()
        torch.manual_seed(1)
        self.model = Nano(self.config)
        if not state:
            clips = sample_clips(run, stream, "train", "112x70")
            whiten_patches(self.model, torch.cat([normalise(clip.image[None])[0] for clip in clips]))
        self.model.to(device).backbone["pretrained"].watch(WATCHED)
        self.optimisers = optimisers(self.model, recipe.muon_lr, recipe.adam_lr)
        if state:
            self.model.load_state_dict(state["model"])
            for optimiser, values in zip(self.optimisers, state["optimisers"][:2], strict=True):
                optimiser.load_state_dict(values)
            self.step, self.room, self.seconds = state["step"], state["room"], state["seconds"]
            self.views_seen, self.distinct_views = state["views_seen"], state["distinct_views"]
        self.ema = copy.deepcopy(self.model)
        self.ema.backbone["pretrained"].watch(())
        if state:
            self.ema.load_state_dict(state["ema"])
        # Reads from the patches how far they moved; see `losses.match_terms`.
        width = 2 * self.config.dim
        self.reader = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2)).to(device)
        nn.init.zeros_(self.reader[1].weight)
        self.optimisers.append(torch.optim.AdamW(self.reader.parameters(), lr=recipe.adam_lr, weight_decay=0.01))
        if state and "reader" in state:
            self.reader.load_state_dict(state["reader"])
        self.bases = (recipe.muon_lr, recipe.adam_lr, recipe.adam_lr)
        self.rng = random.Random(1000 * (rank + 1) + self.step)
        # What all processes must choose alike.
        self.common_rng = random.Random(self.step)
        self.team = Team(1, 0)
        # Somebody asked for the end; all processes stop after the same step.
        self.asked, self.stopping = False, False

    def parameters(self) -> list[nn.Parameter]:
        """All that is learned."""
        return [*self.model.parameters(), *self.reader.parameters()]

    def join(self, team: Team) -> None:
        """Works as one of several from now on."""
        self.team = team
        self.optimisers[0].divide(self.rank, team.processes, team.directions, team.barrier.wait)

    def save(self) -> None:
        """Replaces `state.pt` at once, so that a crash leaves the old or the new one."""
        state = {
            "config": self.config.as_dict(),
            "model": self.model.state_dict(),
            "ema": self.ema.state_dict(),
            "reader": self.reader.state_dict(),
            "optimisers": [o.state_dict() for o in self.optimisers],
            "step": self.step,
            "room": self.room,
            "seconds": self.seconds,
            "views_seen": self.views_seen,
            "distinct_views": self.distinct_views,
        }
        partial = self.run / "state.pt.partial"
        torch.save(state, partial)
        os.replace(partial, self.run / "state.pt")

    def batch(self, pool: Pool, stage: Stage) -> tuple[Scenes, bool]:
        """Scenes of a random number of views, and whether cameras are given."""
        per_clip = stage.views_per_clip
        # What decides how long a step takes is the same for all processes, since they wait for each other.
        sizes = stage.weighted_sizes()
        size = self.common_rng.choices(list(sizes), list(sizes.values()))[0]
        shares = dict(map(int, part.split(":")) for part in stage.scene_views.split(","))
        possible = [views for views in shares if views <= per_clip]
        views = self.common_rng.choices(possible, [shares[v] for v in possible])[0]
        # Scenes of one clip resemble each other: they come from as many clips as can be.
        wanted = max(1, stage.views_per_step // views)
        sources = min(wanted, MOST_CLIPS)
        clips = pool.draw(sources, size, wanted / sources * views / per_clip)
        parts = []
        for k, clip in enumerate(clips):
            groups = wanted // len(clips) + (k < wanted % len(clips))
            parts.extend((clip, own, mirrored) for own, mirrored in self.split(len(clip.image), views, groups))
        found = scenes(parts, self.device)
        found.images = varied(found.images, stage.augmented, self.rng)
        return found, self.common_rng.random() < self.recipe.posed_share

    def split(self, available: int, views: int, wanted: int) -> list[tuple[list[int], bool]]:
        """At most `wanted` disjoint groups of views of a clip: neighbours or spread out, in random order, mirrored or
        not."""
        groups = available // views
        index = list(range(available))
        if self.rng.random() < 0.5:
            chosen = [index[g * views : (g + 1) * views] for g in range(groups)]
        else:
            chosen = [index[g::groups][:views] for g in range(groups)]
        chosen = self.rng.sample(chosen, min(wanted, groups))
        for group in chosen:
            self.rng.shuffle(group)
        return [(group, self.rng.random() < 0.5) for group in chosen]

    def learn(self, batch: Scenes, posed: bool, match: float = 1.0, depth: float = 1.0) -> dict[str, float]:
        """One step; `match` and `depth` as in `Stage`."""
        factor = self.recipe.lr_factor(self.step)
        for optimiser, base in zip(self.optimisers, self.bases, strict=True):
            for group in optimiser.param_groups:
                group["lr"] = base * factor * group.get("share", 1.0)
        rays = self.common_rng.random() < self.recipe.ray_share
        output = self.model(batch.images, batch.pose9 if posed else None, wants_rays=rays, autocast=True)
        loss, terms = total(output, batch, self.reader, match, depth)
        for optimiser in self.optimisers:
            optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self.stopping = self.team.average(self.rank, self.parameters(), self.asked)
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), 2.0)
        if torch.isfinite(norm):
            for optimiser in self.optimisers:
                optimiser.step()
        self.step += 1
        self.views_seen += batch.images.shape[0] * batch.images.shape[1] * self.team.processes
        decay = min(self.recipe.ema_decay, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            kept = list(self.ema.parameters())
            torch._foreach_lerp_(kept, list(self.model.parameters()), 1 - decay)
        return {"loss": loss.item(), "norm": norm.item(), **terms}

    def validate(self) -> None:
        """Appends errors on rooms of the validation split."""
        for size in ("112x70", NATIVE):
            clips = sample_clips(self.run, self.stream, "val", size)
            for views, posed in ((1, False), (4, False), (8, False), (8, True)):
                # The low size is for the curve, the native one for the truth.
                tally = Tally()
                for clip in clips[: 24 if size == "112x70" else 12]:
                    step = len(clip.image) // views
                    add_scenes(
                        tally, self.ema, scenes([(clip, list(range(0, len(clip.image), step))[:views], False)]), posed
                    )
                row = {"step": self.step, "hours": round(self.seconds / 3600, 3), "size": size, "views": views}
                append(self.run / "validation.csv", {**row, "posed": int(posed), **rounded(tally.row())})

    def train(self, save_every_secs: float, validate_every: int) -> None:
        """Until the recipe ends."""
        began = saved = time.monotonic()
        signal.signal(signal.SIGTERM, lambda *_: setattr(self, "asked", True))
        while (found := self.recipe.stage(self.step)) is not None and not self.stopping:
            begin, stage = found
            arguments = ["--sizes", stage.sizes, "--views", str(stage.views_per_clip)]
            arguments += ["--clips", str(self.recipe.clips_per_room), "--home-share", str(stage.home_share)]
            # Each renderer of each process has its own rooms.
            first_rooms = [self.room + (self.rank * self.renderers + k) * ROOMS_APART for k in range(self.renderers)]
            renderer = Renderer(self.stream, [[*arguments, "--first-room", str(room)] for room in first_rooms])
            pool = Pool(iter(renderer), 800 if stage.views_per_clip <= 8 else 400, self.recipe.clip_uses, self.rng)
            print(f"step {self.step}: {stage}, rooms from {first_rooms}", flush=True)
            seen_before = self.distinct_views
            sums: dict[str, list[float]] = {}
            while self.step < stage.until_step and not self.stopping:
                tick = time.monotonic()
                batch, posed = self.batch(pool, stage)
                waited = time.monotonic() - tick
                terms = self.learn(batch, posed, stage.match, stage.depth)
                terms["waited"] = waited
                terms["took"] = time.monotonic() - tick
                self.seconds += terms["took"]
                self.room = max(self.room, pool.rooms)
                self.distinct_views = seen_before + pool.views * self.team.processes
                for name, value in terms.items():
                    sums.setdefault(name, []).append(value)
                if self.step % 25 == 0 and self.rank == 0:
                    means = {name: sum(v) / len(v) for name, v in sums.items()}
                    head = {"step": self.step, "hours": round(self.seconds / 3600, 3), "views": self.views_seen}
                    head |= {"distinct_views": self.distinct_views, "rooms": self.room}
                    names = "loss norm depth aligned gradient ray t q fov pair first moved waited took".split()
                    row = {**head, **rounded({n: means.get(n, float("nan")) for n in names})}
                    append(self.run / "train.csv", row)
                    print(" ".join(f"{k} {v}" for k, v in row.items()), flush=True)
                    sums = {}
                if validate_every and self.step % validate_every == 0 and self.rank == 0:
                    self.validate()
                if time.monotonic() - saved > save_every_secs and self.rank == 0:
                    self.save()
                    saved = time.monotonic()
            renderer.stop()
            if self.rank == 0:
                self.save()
        if self.rank > 0:
            return
        if self.stopping:
            print(f"stopped and saved at step {self.step}", flush=True)
            return
        if validate_every:
            self.validate()
        print(f"the recipe's last step is done after {time.monotonic() - began:.0f} s", flush=True)


def trainer_of(arguments: argparse.Namespace, rank: int) -> Trainer:
    """The trainer of one process."""
    torch.set_num_threads(arguments.threads)
    recipe = Recipe.read(arguments.recipe)
    return Trainer(arguments.run, recipe, arguments.stream, arguments.device, rank, renderers=arguments.renderers)


def work(rank: int, arguments: argparse.Namespace, team: Team) -> None:
    """Another process of training."""
    trainer = trainer_of(arguments, rank)
    trainer.join(team)
    trainer.train(arguments.save_every, arguments.validate_every)


def rounded(row: dict[str, float]) -> dict[str, float]:
    """Four digits are enough for a log."""
    return {name: float(f"{value:.4g}") for name, value in row.items()}


def append(path: Path, row: dict[str, float | str]) -> None:
    """One line of CSV; the first call writes the names."""
    is_new = not path.exists()
    with path.open("a", newline="") as out:
        writer = csv.DictWriter(out, list(row))
        if is_new:
            writer.writeheader()
        writer.writerow(row)


def sample_clips(run: Path, stream: Path, split: str, size: str) -> list[Clip]:
    """One clip of each of 24 rooms of a split, rendered once."""
    path = run / f"{split}_{size}.bin"
    if not path.exists():
        partial = path.with_suffix(".partial")
        with partial.open("wb") as out:
            arguments = ["--split", split, "--rooms", "24", "--clips", "1", "--views", "8", "--sizes", size]
            subprocess.run([str(stream), *arguments], stdout=out, check=True)
        os.replace(partial, path)
    return clips_of(path)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--recipe", type=Path, default=ROOT / "recipe.json")
    parser.add_argument("--stream", type=Path, default=ROOT.parent / "target/release/examples/stream_views")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--renderers", type=int, default=1, help="that each process takes its rooms from")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--save-every", type=float, default=180.0, help="seconds")
    parser.add_argument("--validate-every", type=int, default=500, help="steps; 0: never")
    arguments = parser.parse_args()
    arguments.run.mkdir(parents=True, exist_ok=True)
    # The first makes what all need (sample clips) before the others look for it.
    first = trainer_of(arguments, 0)
    others = []
    if arguments.processes > 1:
        team = Team(arguments.processes, sum(p.numel() for p in first.parameters()))
        first.join(team)
        spawn = multiprocessing.get_context("spawn")
        others = [spawn.Process(target=work, args=(r, arguments, team)) for r in range(1, arguments.processes)]
    for process in others:
        process.daemon = True
        process.start()
    first.train(arguments.save_every, arguments.validate_every)
    for process in others:
        process.join()


if __name__ == "__main__":
    main()
