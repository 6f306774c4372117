"""Reads what `vidar depth --format npz,mini_npz,glb,colmap,depth_vis` wrote with numpy, pycolmap and Pillow.

    python tools/check_official_exports.py FOLDER

Needs numpy; pycolmap and Pillow where their files are to be checked. Prints what it found and fails on contradictions.
"""

import json
import struct
import sys
from pathlib import Path

import numpy as np

folder = Path(sys.argv[1])
arrays = {}
for kind in ("npz", "mini_npz"):
    path = folder / "exports" / kind / "results.npz"
    if path.exists():
        arrays = dict(np.load(path))
        print(path, {k: (v.dtype.str, v.shape) for k, v in arrays.items()})
        n, h, w = arrays["depth"].shape
        assert arrays["depth"].dtype == np.float32 and np.isfinite(arrays["depth"]).all()
        assert arrays.get("extrinsics", np.zeros((n, 3, 4))).shape == (n, 3, 4)
        assert arrays.get("intrinsics", np.zeros((n, 3, 3))).shape == (n, 3, 3)
        if kind == "npz":
            assert arrays["image"].shape == (n, h, w, 3) and arrays["image"].dtype == np.uint8

if (folder / "scene.glb").exists():
    data = (folder / "scene.glb").read_bytes()
    magic, version, total, length, _ = struct.unpack("<5I", data[:20])
    assert magic == 0x46546C67 and version == 2 and total == len(data)
    document = json.loads(data[20 : 20 + length])
    start = 20 + length + 8
    points = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    view = document["bufferViews"][points["bufferView"]]
    values = np.frombuffer(data, np.float32, points["count"] * 3, start + view["byteOffset"]).reshape(-1, 3)
    assert np.allclose(values.min(0), points["min"]) and np.allclose(values.max(0), points["max"])
    assert np.abs(np.median(values, 0)).max() < 1e-3 * np.ptp(values)
    print("scene.glb", points["count"], "points,", len(document["meshes"]) - 1, "cameras")

if (folder / "colmap").exists():
    import pycolmap

    model = pycolmap.Reconstruction(folder / "colmap")
    print("colmap", model.num_cameras(), "cameras", model.num_reg_images(), "images", model.num_points3D(), "points")
    errors = []
    for point_id, point in list(model.points3D.items())[::997]:
        element = point.track.elements[0]
        image = model.images[element.image_id]
        seen = image.points2D[element.point2D_idx]
        assert seen.point3D_id == point_id
        camera = model.cameras[image.camera_id]
        projected = camera.img_from_cam(image.cam_from_world() * point.xyz)
        errors.append(np.abs(np.asarray(projected) - seen.xy).max())
    scale = max(c.width for c in model.cameras.values()) / (arrays["depth"].shape[2] if arrays else 1)
    print(f"  reprojection at most {max(errors):.4f} px; one pixel of the network is {scale:.2f} px")
    assert max(errors) <= 1.0 + 1e-3

for picture in sorted((folder / "depth_vis").glob("*.jpg")):
    from PIL import Image

    with Image.open(picture) as opened:
        opened.load()
        print(picture.name, opened.size)
