"""Reads what `vidar depth --format npz,mini_npz,glb,colmap,depth_vis` wrote with numpy, pycolmap, trimesh and Pillow.

    python tools/check_official_exports.py FOLDER

Needs numpy; pycolmap, trimesh and Pillow where their files are to be checked. Prints what it found and fails on
contradictions: keys, shapes and rounding of the arrays are the official program's, the cameras of every format are those of
`predictions.json`, and points of the COLMAP model project to where they were seen.
"""

import json
import struct
import sys
from pathlib import Path

import numpy as np

folder = Path(sys.argv[1])
arrays = {}
cameras = ["conf", "extrinsics", "intrinsics"]
views = json.loads((folder / "predictions.json").read_text())["views"]
for kind in ("npz", "mini_npz"):
    path = folder / "exports" / kind / "results.npz"
    if path.exists():
        arrays = dict(np.load(path))
        expected = (["image"] if kind == "npz" else []) + ["depth"] + [k for k in cameras if k in arrays]
        assert list(np.load(path).files) == expected, (list(np.load(path).files), expected)
        places = 6 if kind == "npz" else 8
        assert np.array_equal(arrays["depth"], np.round(arrays["depth"], places))
        assert "conf" not in arrays or np.array_equal(arrays["conf"], np.round(arrays["conf"], 2))
        for i, view in enumerate(views if "extrinsics" in arrays else []):
            world_from_camera = np.array(view["world_from_camera"], float).reshape(-1, 4)
            camera_from_world = np.vstack([arrays["extrinsics"][i], [0, 0, 0, 1]]).astype(float)
            world_from_camera = np.vstack([world_from_camera[:3], [0, 0, 0, 1]])
            assert np.allclose(camera_from_world @ world_from_camera, np.eye(4), atol=1e-5)
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
    import trimesh

    scene = trimesh.load(folder / "scene.glb")
    clouds = [g for g in scene.geometry.values() if isinstance(g, trimesh.points.PointCloud)]
    frusta = [g for g in scene.geometry.values() if isinstance(g, trimesh.path.Path3D)]
    assert len(clouds) == 1 and np.allclose(clouds[0].vertices, values) and len(clouds[0].colors) == len(values)
    assert len(frusta) == len(document["meshes"]) - 1 == len(views)
    # Four edges from the centre and four around the picture, two ends each.
    assert all(path.vertices.shape == (16, 3) for path in frusta)
    print("scene.glb", points["count"], "points,", len(document["meshes"]) - 1, "cameras")

if (folder / "colmap").exists():
    import pycolmap

    model = pycolmap.Reconstruction(folder / "colmap")
    print("colmap", model.num_cameras(), "cameras", model.num_reg_images(), "images", model.num_points3D(), "points")
    assert model.num_reg_images() == len(views)
    by_id = sorted(model.images.items())
    for i, (_, image) in enumerate(by_id if "extrinsics" in arrays else []):
        assert np.allclose(image.cam_from_world().matrix(), arrays["extrinsics"][i], atol=1e-5)
        size = np.array([model.cameras[image.camera_id].width, model.cameras[image.camera_id].height])
        scale = size / np.array(arrays["depth"].shape[2:0:-1])
        focal = np.diag(arrays["intrinsics"][i])[:2] * scale
        assert np.allclose(model.cameras[image.camera_id].params[:2], focal, rtol=1e-5), (focal, image)
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
