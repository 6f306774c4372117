"""Runs from Python and by the program have the same bits."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from conftest import call

import vidar

# What says when and how a run was made, not what it made.
ABOUT = {"manifest.json", "log.jsonl", "README.txt", "report.html"}


def hashes(run):
    files = (p for p in sorted(run.rglob("*")) if p.is_file())
    return {p.relative_to(run).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def same_files(one, other):
    a, b = hashes(one), hashes(other)
    assert a.keys() == b.keys()
    differ = [name for name in a if a[name] != b[name] and name not in ABOUT]
    assert not differ, differ
    return a


def result(run):
    """The result in the manifest without times."""
    value = json.loads((run / "manifest.json").read_text())["result"]
    return {k: v for k, v in value.items() if k != "seconds"}


def test_a_run_has_the_same_bits(tiny, settings, finished, tmp_path):
    events = []
    run = vidar.run(tiny, tmp_path / "run", config=settings, progress=events.append)
    assert {"map/mesh.ply", "map/mesh.glb", "eval/metrics.json"} <= same_files(run.folder, finished).keys()
    assert result(run.folder) == result(finished)
    assert {e["event"] for e in events} >= {"stage-started", "progress", "finished"}
    assert run.exit_status == json.loads((finished / "manifest.json").read_text())["exit"]


def test_options_of_the_command_line_mean_the_same(tiny, settings, tmp_path):
    call("run", tiny, "-o", tmp_path / "a", "--config", settings, "-q", "--geometry", "da3-nano", "--stride", "2",
         "--set", "fusion.voxel_size_m=0.06", "--set", "model.network.preprocess.process_size_px=112")
    run = vidar.run(tiny, tmp_path / "b", config=settings, geometry="da3-nano", stride=2,
                    settings={"fusion.voxel_size_m": 0.06, "model.network.preprocess.process_size_px": 112})
    same_files(run.folder, tmp_path / "a")


def test_a_run_for_viewers_is_read_by_the_formats_own_reader(tiny, settings, tmp_path):
    reader = pytest.importorskip("mcap.reader")
    run = vidar.run(tiny, tmp_path / "run", config=settings, mcap=tmp_path / "run.mcap")
    views = json.loads((run.folder / "views.json").read_text())["views"]
    with open(tmp_path / "run.mcap", "rb") as file:
        opened = reader.make_reader(file)
        summary = opened.get_summary()
        topics = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
        depth = [message.log_time for _, _, message in opened.iter_messages(topics=["/view/depth"])]
    assert topics["/view/depth"] == "foxglove.RawImage" and topics["/tf"] == "foxglove.FrameTransform"
    assert topics["/map/mesh"] == topics["/keyframes"] == "foxglove.SceneUpdate"
    assert depth == [view["time_ns"] for view in views]
    assert summary.statistics.message_count == sum(summary.statistics.channel_message_counts.values()) > len(views)


def test_a_run_is_read_back(finished):
    run = vidar.read_run(finished)
    assert run.exit_status == 0 and run.manifest["schema"] == "vidar.run/1"
    assert run.scores == run.metrics["scores"] == vidar.evaluate(finished).scores
    mesh = run.mesh
    assert mesh.vertices.dtype == np.float32 and mesh.triangles.dtype == np.uint32
    assert mesh.triangles.max() < len(mesh.vertices) == len(mesh.normals) == len(mesh.colors) == len(mesh.confidence)
    assert len(run.points) > 1000
    view = run.views[0]
    width, height = view.size
    assert view.depth.shape == (height, width) and view.image_path.is_file()
    poses = dict(zip(run.keyframes.times_ns.tolist(), run.keyframes.world_from_body))
    assert np.allclose(poses[view.time_ns], view.world_from_camera, atol=1e-8)
    assert len(run.trajectory) >= len(run.keyframes)


def test_a_folder_that_is_no_run_is_an_error(tiny, finished):
    with pytest.raises(vidar.VidarError) as caught:
        vidar.read_run(tiny)
    assert caught.value.code == "E0207" and caught.value.where == str(tiny)
    with pytest.raises(vidar.VidarError) as caught:
        vidar.run(tiny, finished)
    assert caught.value.code == "E0106" and caught.value.exit_status == 2


def test_an_exception_of_progress_stops_the_run(tiny, settings, tmp_path):
    def stop(event):
        if event["event"] == "progress":
            raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        vidar.run(tiny, tmp_path / "run", config=settings, progress=stop)


@pytest.mark.skipif(os.name != "posix", reason="signals of Unix")
def test_ctrl_c_ends_a_run(tiny, settings, tmp_path):
    script = textwrap.dedent(
        """
        import signal, sys, vidar
        # A job in the background of a shell is started with Ctrl-C ignored.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        def tell(event):
            print(event["event"], flush=True)
        try:
            vidar.run(sys.argv[1], sys.argv[2], config=sys.argv[3], progress=tell)
        except KeyboardInterrupt:
            sys.exit(77)
        """
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script, tiny, tmp_path / "run", settings], stdout=subprocess.PIPE, text=True
    )
    for line in process.stdout:
        if line.strip() == "progress":
            process.send_signal(signal.SIGINT)
            break
    process.stdout.read()
    assert process.wait(60) == 77
