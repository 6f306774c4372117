"""Writes a trained network as `config.json` and `model.safetensors` (f16, official key names), and reads it back.

python -m nano.export --run RUN_FOLDER --out ../models/da3-nano [--weights ema|model] [--mean-with FOLDER:SHARE]…
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from safetensors.torch import load, save
from torch import Tensor

from .config import POSITION_GRID, NanoConfig, from_dict
from .halves import read_weights, write_weights
from .model import Nano

PREFIX = "model."
BACKBONE = "backbone.pretrained."
OWN_POSITION = (f"{BACKBONE}pos_grid", f"{BACKBONE}pos_special")
POSITION = f"{BACKBONE}pos_embed"


def exported(model: Nano) -> dict[str, Tensor]:
    """Every tensor under its official key; the trained position grid becomes the full one."""
    tensors = {
        PREFIX + name: p.detach().contiguous() for name, p in model.named_parameters() if name not in OWN_POSITION
    }
    backbone = model.backbone["pretrained"]
    grid = backbone.full_grid().detach().flatten(2).transpose(1, 2)
    tensors[PREFIX + POSITION] = torch.cat([backbone.pos_special.detach(), grid], 1).contiguous()
    return tensors


def imported(tensors: dict[str, Tensor], config: NanoConfig) -> Nano:
    """The network of exported tensors, in f32."""
    model = Nano(config)
    plain = {name.removeprefix(PREFIX): t.float() for name, t in tensors.items()}
    position = plain.pop(POSITION)
    backbone = model.backbone["pretrained"]
    plain[OWN_POSITION[0]] = backbone.pos_grid.detach()
    plain[OWN_POSITION[1]] = position[:, :1].clone()
    model.load_state_dict(plain)
    grid = position[:, 1:].transpose(1, 2).unflatten(2, (POSITION_GRID, POSITION_GRID))
    backbone.pos_full = grid.contiguous()
    return model.eval()


def write(model: Nano, folder: Path) -> None:
    """`config.json` and `model.safetensors`."""
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {name: t.half() for name, t in exported(model).items()}
    if not all(torch.isfinite(t).all() for t in tensors.values()):
        raise ValueError("a weight does not fit 16 bits")
    write_weights(folder, save(tensors))
    model.config.write(folder / "config.json")


def read(folder: Path) -> Nano:
    """A network that `write` wrote."""
    raw = json.loads((folder / "config.json").read_text())
    net, head, cam_enc = (raw["config"][k] for k in ("net", "head", "cam_enc"))
    config = NanoConfig(
        name=raw["model_name"],
        dim=net["embed_dim"],
        depth=net["depth"],
        heads=net["num_heads"],
        out_layers=tuple(net["out_layers"]),
        alt_start=net["alt_start"],
        qknorm_start=net["qknorm_start"],
        rope_start=net["rope_start"],
        features=head["features"],
        out_channels=tuple(head["out_channels"]),
        cam_enc_heads=cam_enc["num_heads"],
        cam_enc_depth=cam_enc["trunk_depth"],
        cam_enc_ratio=cam_enc["mlp_ratio"],
    )
    return imported(load(read_weights(folder)), config)


def mean(networks: list[tuple[Nano, float]]) -> Nano:
    """The weighted mean of ends of one training: often as good as the best of them on rooms like those trained on, and
    better on others (Wortsman et al. 2022). It has the first one's shape; what another one's head reads from other
    blocks, or in other sizes, plays no part."""
    first = networks[0][0]
    weight = dict.fromkeys(exported(first), 0.0)
    total = {name: torch.zeros_like(t) for name, t in exported(first).items()}
    for network, share in networks:
        levels = enumerate(zip(network.config.out_layers, first.config.out_layers, strict=True))
        other = tuple(f"{PREFIX}head.projects.{k}." for k, (own, wanted) in levels if own != wanted)
        for name, tensor in exported(network).items():
            if tensor.shape == total[name].shape and not name.startswith(other):
                total[name] += share * tensor
                weight[name] += share
    return imported({name: t / weight[name] for name, t in total.items()}, first.config)


def trained(run: Path, which: str) -> tuple[Nano, dict]:
    """The network of a run (`ema` or `model`) and what else its state says."""
    state = torch.load(run / "state.pt", map_location="cpu", weights_only=True)
    model = Nano(from_dict(state["config"]))
    model.load_state_dict(state[which])
    return model.eval(), state


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--weights", choices=["ema", "model"], default="ema")
    parser.add_argument(
        "--mean-with",
        action="append",
        default=[],
        help="FOLDER:SHARE of an export that so much is taken from; repeatable",
    )
    arguments = parser.parse_args()
    model, state = trained(arguments.run, arguments.weights)
    if arguments.mean_with:
        others = [
            (read(Path(folder)), float(share)) for folder, _, share in (m.rpartition(":") for m in arguments.mean_with)
        ]
        model = mean([(model, 1 - sum(share for _, share in others)), *others])
    write(model, arguments.out)
    count = sum(t.numel() for t in exported(model).values())
    print(f"step {state['step']}, {count} numbers, {len(read_weights(arguments.out))} bytes")


if __name__ == "__main__":
    main()
