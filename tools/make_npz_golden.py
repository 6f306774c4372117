"""Makes crates/vidar-export/tests/data/numpy_prediction.npz: a tiny prediction as numpy itself writes it.

    python tools/make_npz_golden.py

Needs numpy. The values are formulas, so that the test knows them without the file.
"""

from pathlib import Path

import numpy as np

n, h, w = 2, 3, 4
index = np.arange(n * h * w).reshape(n, h, w)
image = (np.arange(n * h * w * 3).reshape(n, h, w, 3) * 7 % 256).astype(np.uint8)
depth = np.round((0.5 + index / 8).astype(np.float32), 6)
conf = np.round((1.0 + index / 3).astype(np.float32), 2)
extrinsics = np.stack([np.eye(4)[:3], np.eye(4)[:3]]).astype(np.float32)
extrinsics[1, 0, 3] = -0.25
intrinsics = np.stack([np.array([[5, 0, 2], [0, 6, 1.5], [0, 0, 1]])] * n).astype(np.float32)

target = Path(__file__).parent.parent / "crates/vidar-export/tests/data/numpy_prediction.npz"
target.parent.mkdir(exist_ok=True)
np.savez_compressed(target, image=image, depth=depth, conf=conf, extrinsics=extrinsics, intrinsics=intrinsics)
print(target, target.stat().st_size, "bytes, numpy", np.__version__)
