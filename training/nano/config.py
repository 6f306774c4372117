"""Sizes of the network, and how they are written for `vidar-da3` (`config.json`)."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

PATCH = 14  # side of a patch, pixels
POSITION_GRID = 37  # rows and columns of the exported position embedding
NATIVE = "280x182"  # width and height of the pictures that the shipped network is used with
HEAD_LAST = 32  # inner width of the head's last convolutions, fixed by the architecture


@dataclass(frozen=True)
class NanoConfig:
    """A DA3 any-view network; the names follow the official configuration."""

    name: str = "da3-nano"
    dim: int = 192
    depth: int = 12
    heads: int = 3
    # The finest level reads an early block: later ones have forgotten most of the picture (decision 12).
    out_layers: tuple[int, int, int, int] = (1, 5, 9, 11)
    alt_start: int = 2
    qknorm_start: int = 0
    rope_start: int = 0
    features: int = 32
    out_channels: tuple[int, int, int, int] = (96, 96, 96, 96)
    cam_enc_heads: int = 6
    cam_enc_depth: int = 2
    cam_enc_ratio: int = 4
    # Rows and columns of the grid that is trained; the exported grid is its smooth enlargement, so that sizes that
    # were never trained have embeddings between those that were.
    trained_grid: int = 7

    def is_global(self, block: int) -> bool:
        """Whether a block attends across views."""
        return block >= self.alt_start and block % 2 == 1

    def to_json(self) -> dict:
        """What `config.json` holds."""
        net = {
            "name": self.name,
            "embed_dim": self.dim,
            "depth": self.depth,
            "num_heads": self.heads,
            "ffn_layer": "mlp",
            "ffn_hidden": 4 * self.dim,
            "position_grid": POSITION_GRID,
            "out_layers": list(self.out_layers),
            "alt_start": self.alt_start,
            "qknorm_start": self.qknorm_start,
            "rope_start": self.rope_start,
            "cat_token": True,
        }
        head = {"dim_in": 2 * self.dim, "features": self.features, "out_channels": list(self.out_channels)}
        cam_enc = {
            "dim_out": self.dim,
            "num_heads": self.cam_enc_heads,
            "trunk_depth": self.cam_enc_depth,
            "mlp_ratio": self.cam_enc_ratio,
        }
        config = {"net": net, "head": head, "cam_enc": cam_enc, "cam_dec": {"dim_in": 2 * self.dim}}
        return {"model_name": self.name, "config": config}

    def write(self, path: Path) -> None:
        """Writes `config.json`."""
        path.write_text(json.dumps(self.to_json(), indent=1) + "\n")

    def as_dict(self) -> dict:
        """Plain values, for checkpoints."""
        return asdict(self)


def from_dict(values: dict) -> NanoConfig:
    """The inverse of `NanoConfig.as_dict`."""
    return NanoConfig(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})
