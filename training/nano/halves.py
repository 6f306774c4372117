"""`model.safetensors` in two files: registries of crates refuse packages above 10 MB, and da3-nano has 15.6 MB.

The folder `models/da3-nano` is a crate with the first half and holds a crate with the second one.
"""

from __future__ import annotations

from pathlib import Path

WHOLE = "model.safetensors"
HALVES = (f"{WHOLE}.0", f"second-half/{WHOLE}.1")


def read_weights(folder: Path) -> bytes:
    """The file, whole or in halves."""
    whole = folder / WHOLE
    if whole.exists():
        return whole.read_bytes()
    return b"".join((folder / half).read_bytes() for half in HALVES)


def write_weights(folder: Path, data: bytes) -> None:
    """In halves where the folder is the crate, else whole."""
    if not (folder / HALVES[1]).parent.is_dir():
        (folder / WHOLE).write_bytes(data)
        return
    middle = len(data) // 2
    for half, part in zip(HALVES, (data[:middle], data[middle:]), strict=True):
        (folder / half).write_bytes(part)
