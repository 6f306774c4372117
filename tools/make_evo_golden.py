#!/usr/bin/env python3
"""Reference numbers of trajectory evaluation, made by evo (https://github.com/MichaelGrupp/evo).

    pip install evo==1.38.1 && python tools/make_evo_golden.py [--shared DIR]

Writes crates/vidar-eval/tests/data/:
  synthetic_truth.tum, synthetic_estimate.tum   a small made-up flight and a distorted, jittered copy of it
  evo_synthetic.json                            what evo says of those two
  evo_euroc.json                                what evo says of real estimates on EuRoC (only with --shared;
                                                numbers only, the trajectories are not ours to copy)
evo is used as a program through its Python interface; nothing of its source is copied.
"""
import argparse
import json
import pathlib
import tarfile
import tempfile

import numpy as np
from evo import __version__ as evo_version
from evo.core import metrics, sync
from evo.core.units import Unit
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

OUT = pathlib.Path(__file__).resolve().parent.parent / "crates/vidar-eval/tests/data"


def stats(metric):
    s = metric.get_all_statistics()
    return {"count": len(metric.error), **{k: float(s[k]) for k in ("rmse", "mean", "median", "std", "min", "max")}}


def judge(truth_file, estimate_file):
    truth = file_interface.read_tum_trajectory_file(truth_file)
    estimate = file_interface.read_tum_trajectory_file(estimate_file)
    truth, estimate = sync.associate_trajectories(truth, estimate, max_diff=0.01)
    out = {"matched": int(truth.num_poses)}
    for name, with_scale in (("se3", False), ("sim3", True)):
        import copy
        aligned = copy.deepcopy(estimate)
        _, _, scale = aligned.align(truth, correct_scale=with_scale)
        ape = metrics.APE(metrics.PoseRelation.translation_part)
        ape.process_data((truth, aligned))
        out[f"ate_{name}_m"] = stats(ape)
        if with_scale:
            out["scale"] = float(scale)
        else:
            turn = metrics.APE(metrics.PoseRelation.rotation_angle_deg)
            turn.process_data((truth, aligned))
            out["orientation_se3_deg"] = stats(turn)
    steps = (("frames_1", 1, Unit.frames), ("frames_10", 10, Unit.frames), ("metres_1", 1.0, Unit.meters))
    for name, delta, unit in steps:
        for kind, relation in (
            ("translation_m", metrics.PoseRelation.translation_part),
            ("rotation_deg", metrics.PoseRelation.rotation_angle_deg),
        ):
            rpe = metrics.RPE(relation, delta=delta, delta_unit=unit, all_pairs=False)
            rpe.process_data((truth, estimate))
            out[f"rpe_{name}_{kind}"] = stats(rpe)
    return out


def write_tum(path, stamps_ns, positions, rotations):
    with open(path, "w") as f:
        f.write("# timestamp tx ty tz qx qy qz qw\n")
        for t, p, q in zip(stamps_ns, positions, rotations.as_quat()):
            f.write(f"{t // 10**9}.{t % 10**9:09d} " + " ".join(f"{v:.9f}" for v in (*p, *q)) + "\n")


def synthetic():
    """A flight at 40 Hz; the estimate at 20 Hz with jittered stamps, a hole, drift, noise, scale 1.07, another world."""
    rng = np.random.default_rng(7)
    start = 1403636580838555648
    t = np.arange(360) / 40.0

    def flight(t):
        p = np.c_[2 * np.sin(0.7 * t), 1.5 * np.cos(0.5 * t) + 0.1 * t, 1 + 0.4 * np.sin(1.1 * t)]
        return p, Rotation.from_euler("zyx", np.c_[0.6 * t, 0.3 * np.sin(0.9 * t), 0.2 * np.cos(0.8 * t)])

    write_tum(OUT / "synthetic_truth.tum", [start + round(1e9 * x) for x in t], *flight(t))
    te = np.arange(5, 170) / 20.0
    te = te[(te < 4.0) | (te > 4.9)] + rng.uniform(-0.004, 0.004, ((te < 4.0) | (te > 4.9)).sum())
    p, r = flight(te)
    p = p + 0.02 * np.c_[te, -te, 0.3 * te] / 9 + rng.normal(0, 0.006, p.shape)
    r = r * Rotation.from_rotvec(rng.normal(0, 0.004, p.shape))
    world = Rotation.from_rotvec([0.4, -1.1, 2.0])
    p = world.apply(p) / 1.07 + np.array([3.0, -20.0, 0.7])
    write_tum(OUT / "synthetic_estimate.tum", [start + round(1e9 * x) for x in te], p, world * r)
    result = judge(OUT / "synthetic_truth.tum", OUT / "synthetic_estimate.tum")
    (OUT / "evo_synthetic.json").write_text(json.dumps({"evo": evo_version, "result": result}, indent=1) + "\n")


SEQUENCES = {
    "MH_01": "MH_01_easy", "MH_02": "MH_02_easy", "MH_03": "MH_03_medium", "MH_04": "MH_04_difficult",
    "MH_05": "MH_05_difficult", "V1_01": "V1_01_easy", "V1_02": "V1_02_medium", "V1_03": "V1_03_difficult",
    "V2_01": "V2_01_easy", "V2_02": "V2_02_medium", "V2_03": "V2_03_difficult",
}


def euroc(shared):
    results = []
    root = shared / "data/rpg_reference_trajectories"
    with tempfile.TemporaryDirectory() as temp:
        with tarfile.open(shared / "data/packed/euroc_imu_gt_all11.tar.xz") as tar:
            names = [n for n in tar.getnames() if n.endswith("groundtruth_openvins_tum.txt")]
            tar.extractall(temp, members=[tar.getmember(n) for n in names], filter="data")
        for estimate in sorted(root.rglob("stamped_traj_estimate*.txt")):
            sequence = SEQUENCES[estimate.parent.name[-5:]]
            stamps = [line.split()[0] for line in open(estimate) if not line.startswith("#")]
            if any(float(b) <= float(a) for a, b in zip(stamps, stamps[1:])):
                print("left out, stamps do not increase:", estimate)
                continue
            truth = pathlib.Path(temp) / "euroc_imu_gt_all11" / sequence / "groundtruth_openvins_tum.txt"
            results.append({
                "estimate": str(estimate.relative_to(root)), "sequence": sequence, **judge(truth, estimate)
            })
    (OUT / "evo_euroc.json").write_text(json.dumps({"evo": evo_version, "results": results}, indent=0) + "\n")
    print(len(results), "trajectories")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=pathlib.Path, help="folder that holds data/rpg_reference_trajectories")
    shared = parser.parse_args().shared
    OUT.mkdir(parents=True, exist_ok=True)
    synthetic()
    if shared:
        euroc(shared)
