#!/usr/bin/env python3
"""Runs `vidar odometry` and OpenVINS on the same EuRoC-layout recordings and evaluates both with the same code.

Needs: pip install numpy
  bench/ordinary_recordings.sh RECORDINGS
  cargo build --release -p vidar-cli
  python bench/odometry_vs_peers.py RECORDINGS/* --out RESULTS --openvins ov_folder --openvins-config open_vins/config/euroc_mav
  python bench/odometry_vs_peers.py RECORDINGS/* --out RESULTS --table          only the tables, of what has been run

OpenVINS (GPL-3) is no part of this project. `ov_folder SETTINGS FOLDER OUT` is any program that feeds FOLDER/mav0's images (cam0) and
IMU to OpenVINS' VioManager in order, each image once the IMU has passed it (stamp + estimated offset), and writes a line per image
that has a state: stamp in ns, estimated time offset in s, position of the IMU, quaternion x y z w (world from IMU). Its settings are those of
its euroc_mav folder with one camera, dynamic initialisation, two threads, and the recording's calibration and IMU noise. Where a recording has no
calibration it gets what a careful user would guess: f = 0.75 image widths, no distortion, the camera's axes turned right by
quarter turns, no lever arm, the noise of the synthetic IMU. Its time offset begins at 0 ms (`openvins`) or at the truth (`openvins-clock`).

Errors are those of the position of the IMU when the image was truly taken (the middle row; truth.json), after the best rigid motion; ln s is that of
the best similarity. Images: the share that has a pose in the trajectory (VIDAR live: its longest segment), and the share of those since the first
state that have any. `--clock own` takes each program's own estimate of that time instead. Processor time is user time of the
whole process, decoding and (VIDAR) calibration, adjustment and report included.
"""
import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

# Noise densities of a consumer IMU, for recordings that state none: gyroscope, its walk, accelerometer, its walk.
CONSUMER_NOISE = (5e-4, 2e-5, 5e-3, 1e-3)
GUESSED_FOCAL = 0.75
# A trajectory whose error exceeds this share of the path has not stayed bounded.
BOUNDED = 0.1


def listed(text, key):
    """The numbers of `key: [...]`."""
    found = re.search(rf"^\s*{key}:\s*\[([^\]]*)\]", text, re.M)
    return [float(v) for v in found.group(1).split(",")] if found else None


def scalar(text, key):
    found = re.search(rf"^\s*{key}:\s*([-+0-9.eE]+)", text, re.M)
    return float(found.group(1)) if found else None


def table(path):
    return np.loadtxt(path, delimiter=",", comments="#", ndmin=2)


def stamps(path):
    """Integer nanoseconds in a csv's first column."""
    lines = (line.split(",")[0].strip() for line in path.read_text().splitlines())
    return np.array([int(first) for first in lines if first and not first.startswith("#")], np.int64)


class Recording:
    def __init__(self, folder):
        self.folder, self.name = Path(folder), Path(folder).name
        mav = self.folder / "mav0"
        truth = mav / "state_groundtruth_estimate0" / "data.csv"
        self.truth_ns, self.truth = stamps(truth), table(truth)[:, 1:4]
        self.images = stamps(mav / "cam0" / "data.csv")
        device = self.folder / "truth.json"
        self.device = json.loads(device.read_text())["camera"] if device.exists() else {}
        # IMU time = stamp + offset; a recording without truth.json has one clock.
        self.offset = self.device.get("imu_time_minus_stamp_secs", 0.0)
        yaml = mav / "cam0" / "sensor.yaml"
        self.is_given = yaml.exists()
        self.camera = self.given(yaml.read_text()) if self.is_given else self.guessed()
        yaml = mav / "imu0" / "sensor.yaml"
        text = yaml.read_text() if yaml.exists() else ""
        keys = ("gyroscope_noise_density", "gyroscope_random_walk", "accelerometer_noise_density", "accelerometer_random_walk")
        self.noise = tuple(scalar(text, key) or default for key, default in zip(keys, CONSUMER_NOISE))

    @staticmethod
    def given(text):
        return {"resolution": listed(text, "resolution"), "intrinsics": listed(text, "intrinsics"),
                "distortion": listed(text, "distortion_coefficients"), "body_from_camera": listed(text, "data")}

    def guessed(self):
        width, height = self.device["resolution"]
        true = np.array(self.device["body_from_camera"]).reshape(4, 4)
        axes = np.zeros((4, 4))
        axes[3, 3] = 1.0
        for row in range(3):
            column = np.argmax(abs(true[row, :3]))
            axes[row, column] = np.sign(true[row, column])
        focal = GUESSED_FOCAL * width
        return {"resolution": [width, height], "intrinsics": [focal, focal, (width - 1) / 2, (height - 1) / 2],
                "distortion": [0.0] * 4, "body_from_camera": axes.ravel().tolist()}


# ---------------------------------------------------------------------------------------------------- running

def run(command, log):
    """User seconds, wall seconds and exit status of a command; its output goes to a file."""
    begin = time.monotonic()
    with open(log, "wb") as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return {"user_secs": usage.ru_utime, "wall_secs": time.monotonic() - begin, "exit": process.returncode,
            "peak_mb": usage.ru_maxrss / 1024}


def run_vidar(program, recording, out):
    log = out / "vidar.json"
    result = run([program, "odometry", str(recording.folder), "-o", str(out / "vidar"), "--force", "--json"], log)
    (out / "vidar.run.json").write_text(json.dumps(result))


def settings(recording, source, folder, offset):
    """OpenVINS' settings for a recording."""
    folder.mkdir(parents=True, exist_ok=True)
    text = (source / "estimator_config.yaml").read_text()
    changes = {"use_stereo": "false", "max_cameras": "1", "init_dyn_use": "true", "num_opencv_threads": "2",
               "init_dyn_mle_max_threads": "2",
               # Wall time, which a busy machine would turn into a worse solution.
               "init_dyn_mle_max_time": "0.5", "verbosity": '"INFO"'}
    for key, value in changes.items():
        text, n = re.subn(rf"^{key}:\s*\S+", f"{key}: {value}", text, flags=re.M)
        if n != 1:
            raise ValueError(f"{source}/estimator_config.yaml has {n} lines for {key}")
    (folder / "estimator_config.yaml").write_text(text)
    imu = (source / "kalibr_imu_chain.yaml").read_text()
    names = ("gyroscope_noise_density", "gyroscope_random_walk", "accelerometer_noise_density", "accelerometer_random_walk")
    for key, value in zip(names, recording.noise):
        imu = re.sub(rf"^(\s*){key}:\s*\S+", rf"\g<1>{key}: {value!r}", imu, flags=re.M)
    (folder / "kalibr_imu_chain.yaml").write_text(imu)
    camera = recording.camera
    matrix = np.array(camera["body_from_camera"]).reshape(4, 4).tolist()
    rows = "\n".join(f"    - {row}" for row in matrix)
    (folder / "kalibr_imucam_chain.yaml").write_text(
        f"%YAML:1.0\n\ncam0:\n  T_imu_cam:\n{rows}\n  cam_overlaps: []\n  camera_model: pinhole\n"
        f"  distortion_coeffs: {camera['distortion']}\n  distortion_model: radtan\n  intrinsics: {camera['intrinsics']}\n"
        f"  resolution: {[int(v) for v in camera['resolution']]}\n  rostopic: /cam0/image_raw\n  timeshift_cam_imu: {offset!r}\n")
    return folder / "estimator_config.yaml"


def run_openvins(program, source, recording, out, variant):
    offset = recording.offset if variant == "openvins-clock" else 0.0
    config = settings(recording, source, out / variant, offset)
    result = run([program, str(config), str(recording.folder), str(out / f"{variant}.txt")], out / f"{variant}.log")
    (out / f"{variant}.run.json").write_text(json.dumps(result))


# ---------------------------------------------------------------------------------------------------- evaluation

def aligned(estimate, truth, with_scale):
    """Umeyama (1991): scale, and the errors' lengths after truth ≈ s R estimate + t."""
    a, b = estimate - estimate.mean(0), truth - truth.mean(0)
    u, d, vt = np.linalg.svd(b.T @ a / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * sign) @ vt
    scale = float((d * sign).sum() / (a * a).sum(1).mean()) if with_scale else 1.0
    return scale, np.linalg.norm(b - scale * a @ rotation.T, axis=1)


def evaluate(recording, image_ns, positions, imu_ns):
    """Errors of positions of the IMU; image_ns: stamps of their images, imu_ns: when they are compared."""
    inside = (imu_ns >= recording.truth_ns[0]) & (imu_ns <= recording.truth_ns[-1])
    row = {"poses": len(image_ns), "images": len(recording.images)}
    if not np.isfinite(positions).all():
        return row | {"is_bounded": False}
    if inside.sum() < 3:
        return row
    at = (imu_ns[inside] - recording.truth_ns[0]).astype(float)
    since = (recording.truth_ns - recording.truth_ns[0]).astype(float)
    truth = np.stack([np.interp(at, since, recording.truth[:, k]) for k in range(3)], 1)
    estimate = positions[inside]
    path = float(np.linalg.norm(np.diff(truth, axis=0), axis=1).sum())
    _, errors = aligned(estimate, truth, False)
    scale, _ = aligned(estimate, truth, True)
    ate = float(np.sqrt((errors**2).mean()))
    after = int((recording.images >= image_ns[0]).sum())
    return row | {"ate_m": ate, "max_m": float(errors.max()), "path_m": path, "ate_percent": 100 * ate / path,
                  "ln_s": float(np.log(scale)) if scale > 0 else float("inf"), "is_bounded": bool(ate <= BOUNDED * path),
                  "first_secs": 1e-9 * float(image_ns[0] - recording.images[0]),
                  "completion": len(image_ns) / len(recording.images), "after_start": len(image_ns) / after}


def read_poses(path, columns):
    if not path.exists():
        return None
    lines = [line.split() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    if not lines:
        return None
    return [line[0] for line in lines], np.array([[float(v) for v in line[1:columns]] for line in lines])


def decimal_ns(text):
    whole, _, part = text.partition(".")
    return int(whole) * 10**9 + int((part + "0" * 9)[:9])


def health(path):
    """The segment and σ(ln s) of every image; None where there is no state."""
    rows = []
    for line in path.read_text().splitlines():
        fields = line.split(",")
        if not line.startswith("#"):
            rows.append((fields[3], float(fields[5]) if fields[5] else float("inf")) if fields[3] else None)
    return rows


def live_sigma(states, positions):
    """σ(ln s) of the longest segment as VIDAR states it while it runs, without what no estimate sees: that of the path's pieces weighted by
    their lengths, at least that of the newest state."""
    by_segment = {}
    for segment, sigma in filter(None, states):
        by_segment.setdefault(segment, []).append(sigma)
    sigmas = np.array(max(by_segment.values(), key=len, default=[]))
    if len(sigmas) != len(positions):
        return None
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    weighted = float((steps * sigmas[1:]).sum() / steps.sum()) if steps.sum() > 0 else 0.0
    return max(weighted, float(sigmas[-1]))


def evaluate_vidar(recording, out, clock):
    runs = out / "vidar.run.json"
    if not runs.exists():
        return {}
    process = json.loads(runs.read_text())
    text = (out / "vidar.json").read_text()
    start = text.find('{"schema"') if '{"schema"' in text else text.find("{\n")
    told = {}
    if start >= 0:
        try:
            told = json.JSONDecoder().raw_decode(text[start:])[0]
        except json.JSONDecodeError:
            pass
    process |= {"ms_per_image": 1e3 * process["user_secs"] / len(recording.images)}
    rows = {}
    unseen = (told.get("scale") or {}).get("unseen") or 0.0
    folder = out / "vidar"
    folders = [p.parent.parent for p in folder.rglob("odometry/health.csv")] or [folder]
    folder = folders[-1]
    final = told.get("final") or {}
    for kind, file in (("vidar live", "odometry_body"), ("vidar final", "final_body")):
        row = dict(process) | {"images": len(recording.images), "poses": 0, "told": told.get("verdict"), "lost": told.get("lost")}
        found = read_poses(folder / "trajectory" / f"{file}.tum", 8)
        if found:
            image_ns = np.array([decimal_ns(t) for t in found[0]], np.int64)
            offset = recording.offset
            report = final.get("trajectory") if kind == "vidar final" else told.get("trajectory")
            if clock == "own" and kind == "vidar final":
                offset = 1e-3 * final["calibration"]["time_offset_ms"]
            row |= evaluate(recording, image_ns, found[1][:, :3], image_ns + round(1e9 * offset))
            sigma = final.get("scale_std")
            if kind == "vidar live":
                states = health(folder / "odometry" / "health.csv")
                sigma = live_sigma(states, found[1][:, :3])
                # The trajectory is the longest segment; a loss before or after it counts against what came after the first state.
                first = next(i for i, state in enumerate(states) if state)
                row["after_start"] = sum(map(bool, states)) / (len(states) - first)
            row |= {"sigma": sigma and float(np.hypot(sigma, unseen)), "sigma_alone": sigma,
                    "own_ate_m": ((report or {}).get("ate_se3_m") or {}).get("rmse"), "ms_tracking": told["milliseconds_per_image"]}
        rows[kind] = row
    return rows


def evaluate_openvins(recording, out, variant, clock):
    runs = out / f"{variant}.run.json"
    if not runs.exists():
        return {}
    row = json.loads(runs.read_text()) | {"images": len(recording.images), "poses": 0}
    row["ms_per_image"] = 1e3 * row["user_secs"] / len(recording.images)
    found = read_poses(out / f"{variant}.txt", 9)
    if found:
        image_ns = np.array([int(t) for t in found[0]], np.int64)
        offsets = found[1][:, 0] if clock == "own" else np.full(len(image_ns), recording.offset)
        row |= evaluate(recording, image_ns, found[1][:, 1:4], image_ns + np.round(1e9 * offsets).astype(np.int64))
        row["offset_error_ms"] = float(1e3 * (found[1][-1, 0] - recording.offset))
    return {variant: row}


# ---------------------------------------------------------------------------------------------------- tables

def number(row, key, digits, factor=1.0):
    value = row.get(key)
    return "–" if value is None or not np.isfinite(value) else f"{factor * value:.{digits}f}"


def errors(row):
    """ATE and its share of the path, or why there is none."""
    if not row:
        return "not run"
    if not row.get("poses"):
        return "no pose"
    if "ate_m" not in row:
        return "not finite"
    if row["is_bounded"]:
        return f"{row['ate_m']:.4f} ({row['ate_percent']:.2f})"
    return f"{row['ate_m']:.3g} (**{row['ate_percent']:.0f}**)"


def scale(row):
    if not row.get("is_bounded"):
        return "–"
    sigma = f" ({row['sigma_alone']:.4f})" if row.get("sigma_alone") is not None else ""
    return f"{row['ln_s']:+.4f}{sigma}"


def tell(recordings, results, kinds):
    """A row per recording."""
    columns = []
    for kind in kinds:
        columns += [f"{kind}: ATE m (%)"] + ["ln s (σ)"] * kind.startswith("vidar") + ["images %"] * (kind != "vidar final")
    print("| Recording | Size | Readout, delay ms | Path m | " + " | ".join(columns) + " | ms an image |")
    print("|---|---|---|--:|" + "--:|" * len(columns) + "--:|")
    for name, rows in results.items():
        recording = recordings[name]
        width, height = recording.camera["resolution"]
        device = recording.device
        clock = f"{1e3 * device['readout_secs']:.0f}, {1e3 * device['stamp_delay_secs']:+.0f}" if device else "0, 0"
        # Of the program that gives most of it.
        path = number({"path_m": max((row.get("path_m", 0.0) for row in rows.values()), default=0.0)}, "path_m", 1)
        cells = []
        for kind in kinds:
            row = rows.get(kind, {})
            cells += [errors(row)] + [scale(row)] * kind.startswith("vidar")
            cells += [number(row, "completion", 0, 100)] * (kind != "vidar final")
        # Live and final poses come from one process.
        times = ", ".join(number(rows[k], "ms_per_image", 0) for k in kinds if k in rows and k != "vidar live")
        print(f"| {name} | {width:.0f}×{height:.0f} | {clock} | {path} | {' | '.join(cells)} | {times} |")


def summary(results, kinds):
    """Medians, in which a recording without a pose counts as the worst; then what the goals of the project ask."""
    of = {kind: [r[kind] for r in results.values() if kind in r] for kind in kinds}
    print("\n| Program | Recordings | With poses | Bounded | ATE m | % of path | \\|ln s\\| | Images % | Of those after the start % | First pose, s | ms an image |")
    print("|---|" + "--:|" * 10)
    for kind, rows in of.items():
        if not rows:
            continue
        middle = lambda key, digits: f"{statistics.median(abs(r.get(key, np.inf)) for r in rows):.{digits}f}"
        share = lambda key: f"{100 * statistics.median(r.get(key, 0.0) for r in rows):.1f}"
        counts = (len(rows), sum(bool(r.get("poses")) for r in rows), sum(r.get("is_bounded", False) for r in rows))
        cells = [*map(str, counts), middle("ate_m", 4), middle("ate_percent", 2), middle("ln_s", 4), share("completion"),
                 share("after_start"), middle("first_secs", 2), middle("ms_per_image", 0)]
        print(f"| {kind} | {' | '.join(cells)} |")
    print("\n| Goal | " + " | ".join(k for k in kinds if k.startswith("vidar")) + " |")
    print("|---|" + "--:|" * sum(k.startswith("vidar") for k in kinds))
    goals = {}
    for kind, rows in of.items():
        if not kind.startswith("vidar"):
            continue
        def put(goal, text):
            goals.setdefault(goal, []).append(text)
        complete = [r["after_start"] for r in rows if "after_start" in r]
        put("images with a pose after the start: ≥ 98 %, recordings", f"{sum(c >= 0.98 for c in complete)} of {len(rows)}")
        put("the same, least of those that started", f"{100 * min(complete, default=0.0):.1f} %")
        put("ATE, median % of the path", f"{statistics.median(r.get('ate_percent', np.inf) for r in rows):.2f}")
        for key, words in (("sigma_alone", "σ of the estimate"), ("sigma", "σ as stated, with what no estimate sees")):
            stated = [(abs(r["ln_s"]), r[key]) for r in rows if r.get(key) is not None and "ln_s" in r]
            for factor in (2, 3):
                put(f"\\|ln s\\| within {factor} σ, {words}", f"{sum(e <= factor * s for e, s in stated)} of {len(stated)}")
            sure = [e for e, s in stated if s <= 0.03]
            put(f"\\|ln s\\|, median where {words.split(',')[0]} ≤ .03", f"{statistics.median(sure):.4f} ({len(sure)})" if sure else "–")
    for goal, cells in goals.items():
        print(f"| {goal} | {' | '.join(cells)} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results; what is there is not run again")
    parser.add_argument("--vidar", default="target/release/vidar")
    parser.add_argument("--openvins", help="the program that feeds a folder to OpenVINS")
    parser.add_argument("--openvins-config", type=Path, help="config/euroc_mav of its checkout")
    parser.add_argument("--variants", nargs="+", default=["openvins", "openvins-clock"])
    parser.add_argument("--clock", choices=["true", "own"], default="true")
    parser.add_argument("--table", action="store_true", help="run nothing")
    args = parser.parse_args()
    recordings, results, given, absent = {}, {}, {}, {}
    kinds = ["vidar final", "vidar live", *args.variants]
    for folder in args.recordings:
        recording = Recording(folder)
        out = args.out / recording.name
        out.mkdir(parents=True, exist_ok=True)
        if not args.table and not (out / "vidar.run.json").exists():
            run_vidar(args.vidar, recording, out)
        for variant in args.variants if args.openvins and not args.table else []:
            if not (out / f"{variant}.run.json").exists():
                run_openvins(args.openvins, args.openvins_config, recording, out, variant)
        rows = evaluate_vidar(recording, out, args.clock)
        for variant in args.variants:
            rows |= evaluate_openvins(recording, out, variant, args.clock)
        print(recording.name, *(f"{kind}: {errors(row)};" for kind, row in rows.items()), file=sys.stderr, flush=True)
        recordings[recording.name], results[recording.name] = recording, rows
        (given if recording.is_given else absent)[recording.name] = rows
    (args.out / f"results-{args.clock}-clock.json").write_text(json.dumps(results, indent=1))
    for title, part in (("Calibration given", given), ("No calibration", absent)):
        if part:
            print(f"\n{title}\n")
            tell(recordings, part, kinds)
            summary(part, kinds)


if __name__ == "__main__":
    main()
