"""A recording to the input of nerfstudio: undistorted images, transforms.json, initial points.

    python to_nerfstudio.py RECORDING RUN OUTPUT [SETTINGS.toml]
    ns-train splatfacto --data OUTPUT
"""

import json
import pathlib
import sys

import numpy as np

import vidar


def progress(event: dict) -> None:
    """One line per stage."""
    if event["event"] == "stage-finished":
        print(f"{event['stage']} done in {event['seconds']:.1f} s")


def main(recording: pathlib.Path, folder: pathlib.Path, output: pathlib.Path, *settings: str) -> None:
    run = vidar.run(recording, folder, config=settings[0] if settings else None, progress=progress)
    run.export("nerfstudio", output)

    transforms = json.loads((output / "transforms.json").read_text())
    views = {view.time_ns: view for view in run.views}
    assert len(transforms["frames"]) == len(views)
    # nerfstudio's camera looks along -z with y up: VIDAR's with two axes turned round. Metres, nothing re-centred.
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    for frame, view in zip(transforms["frames"], views.values()):
        assert np.allclose(np.array(frame["transform_matrix"]) @ flip, view.world_from_camera, atol=1e-6)
        assert (output / frame["file_path"]).is_file()
    print(f"{len(views)} images in {output}")


if __name__ == "__main__":
    main(*map(pathlib.Path, sys.argv[1:4]), *sys.argv[4:])
