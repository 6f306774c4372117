#!/usr/bin/env python3
"""Converts SALAD's published checkpoint (a Python pickle) to safetensors, same tensors, same keys, float32.

Needs: pip install torch safetensors
  python tools/salad_to_safetensors.py dino_salad.ckpt dino_salad.safetensors
  vidar run … --set coupling.salad_checkpoint=dino_salad.safetensors

The pickle is read with `weights_only=True`: nothing in it is run.
"""
import sys

import torch
from safetensors.torch import save_file


def main(source: str, target: str) -> None:
    state = torch.load(source, map_location="cpu", weights_only=True)
    state = state.get("state_dict", state)
    tensors = {
        key: value.to(torch.float32).contiguous().clone()
        for key, value in state.items()
        if key.startswith(("backbone.model.", "aggregator."))
    }
    # A learned scalar.
    tensors["aggregator.dust_bin"] = tensors["aggregator.dust_bin"].reshape(1)
    save_file(tensors, target)
    print(f"{target}: {len(tensors)} tensors")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
