"""A batch on Ray: two nodes of one processor each, one of which dies while it predicts."""

import hashlib
import pathlib
import sys
import threading
import time

import pytest
from conftest import ROOT, call, program

ray = pytest.importorskip("ray", reason="SKIPPED WITHOUT RAY: pip install ray")
sys.path.insert(0, str(ROOT / "python"))
import vidar_ray  # noqa: E402

cluster_utils = pytest.importorskip("ray.cluster_utils")

FLIGHT = "duration_secs = 4.0\ncamera_rate_hz = 20.0\nwidth = 320\nheight = 208\ndepth = false\nblur_samples = 1\nscan_spacing_m = 0.2\n"
SETTINGS = ["--stride", "2", "--set", "geometry.chunk_keyframes=4", "--set", "output.report=false"]


def mesh_hash(folder: pathlib.Path) -> str:
    return hashlib.sha256((folder / "map/mesh.ply").read_bytes()).hexdigest()


@pytest.fixture
def recordings(tmp_path):
    (tmp_path / "world.toml").write_text(FLIGHT)
    for seed, name in enumerate(["one", "two"]):
        call("synth", tmp_path / name, "--world-config", tmp_path / "world.toml", "--seed", seed, "-q")
    (tmp_path / "garbage.bag").write_bytes(b"no bag" * 100)
    return [tmp_path / name for name in ["one", "two", "garbage.bag"]]


@pytest.fixture
def cluster():
    # The head has no processor of its own: tasks run on the two nodes, which can die.
    made = cluster_utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    yield made
    ray.shutdown()
    made.shutdown()


def test_a_node_dies_while_it_predicts_and_the_maps_are_those_of_run(tmp_path, recordings, cluster):
    nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
    store = tmp_path / "store"
    planned = vidar_ray.call(str(program()), ["plan", *map(str, recordings), "--store", str(store), "--parts", "2", *SETTINGS])
    ray.init(address=cluster.address, log_to_driver=False)
    batch = vidar_ray.Batch(planned, str(program()))
    ended = {}
    driver = threading.Thread(target=lambda: ended.update(zip(["table", "unfinished"], batch.run())))
    driver.start()
    # A chunk is there, but not its part: a node is at it.
    while driver.is_alive() and not any(store.glob("predict/*/chunks/*.json")):
        time.sleep(0.01)
    maps_before = list(store.glob("maps/*"))
    cluster.remove_node(nodes[1], allow_graceful=False)
    driver.join()

    assert ended["unfinished"] == {}
    table = ended["table"]
    assert table["counts"].get("failed") == 1 and "missing" not in table["counts"]
    assert maps_before == [], "the node died while the batch predicted"
    rows = {pathlib.Path(row["path"]).name: row for row in table["recordings"]}
    assert rows["garbage.bag"]["problem"]["code"] == "E0201"
    for name, recording in zip(["one", "two"], recordings):
        call("run", recording, "-o", tmp_path / f"run {name}", "-q", *SETTINGS)
        assert rows[name]["result"]["map_sha256"] == mesh_hash(tmp_path / f"run {name}")
        assert mesh_hash(store / rows[name]["map"]) == rows[name]["result"]["map_sha256"]
