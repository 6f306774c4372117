#!/usr/bin/env python3
"""Times Depth Anything 3 here against the official PyTorch code, in turn, in one run.

    cargo build --release -p vidar-da3 --example time_da3
    python3 -m venv venv && venv/bin/pip install -r bench/requirements-da3.txt
    venv/bin/pip install --no-deps depth-anything-3==0.1.1
    venv/bin/python bench/da3_vs_torch.py --ours target/release/examples/time_da3 --out da3.json

Both sides run the network's forward pass on the same number of pixels with the same number of threads; weights are
random on both sides (time does not depend on them). For each model and number of views every engine gets its own process;
rounds go through the engines in turn, after warm-up rounds. Reported are medians of process CPU seconds and of wall
seconds, and the process's largest memory beyond what it had with weights loaded. On a busy machine trust CPU seconds. The
official code computes its ray branch and discards it when it is not requested; here it is skipped: the results are
the same. What a worker writes to standard error is shown when it ends early.

Engines: torch-f32, torch-bf16 (autocast, which leaves the head in f32), torch-f32-avx2 (oneDNN, MKL and ATen held to AVX2);
ours-default (precision `auto`), ours-f32, ours-bf16-head32 (the whole backbone in bf16 and the head in f32,
like the official code), ours-bf16 (everything in bf16), ours-f32-avx2.
"""
import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time

AVX2 = {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2", "MKL_ENABLE_INSTRUCTIONS": "AVX2"}
OURS = {
    "ours-default": [],
    "ours-f32": ["--precision", "f32"],
    "ours-bf16": ["--precision", "bf16", "--head-precision", "bf16", "--exact-blocks", "0"],
    "ours-bf16-head32": ["--precision", "bf16", "--head-precision", "f32", "--exact-blocks", "0"],
    "ours-f32-avx2": ["--precision", "f32", "--isa", "avx2"],
}
DEFAULT = ["torch-f32", "torch-bf16", "ours-default", "ours-f32"]
TORCH = ["torch-f32", "torch-bf16", "torch-f32-avx2"]


def cpu_seconds():
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def peak_kb():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmHWM:"))


def torch_worker(model_name, views, rows, columns, precision, threads):
    """One forward pass a line of standard input."""
    # The official code logs to standard output: answers get a channel of their own.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    import torch

    import depth_anything_3
    from depth_anything_3.cfg import create_object, load_config

    torch.set_num_threads(threads)
    torch.manual_seed(1)
    folder = list(depth_anything_3.__path__)[0]
    model = create_object(load_config(f"{folder}/configs/{model_name}.yaml")).eval()
    pixels = torch.randn(1, views, 3, rows, columns)
    weights = peak_kb()
    for _ in sys.stdin:
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            cpu, start = cpu_seconds(), time.perf_counter()
            model(pixels)
            wall, cpu = time.perf_counter() - start, cpu_seconds() - cpu
        print(json.dumps({"wall_s": wall, "cpu_s": cpu, "peak_kb": peak_kb(), "weights_kb": weights}), file=answers, flush=True)


def start(engine, model, views, size, arguments):
    env = dict(os.environ, OMP_WAIT_POLICY="PASSIVE", RAYON_NUM_THREADS=str(arguments.threads))
    rows, columns = size
    if engine in OURS:
        command = [arguments.ours, model, "--views", str(views), "--size", f"{rows}x{columns}", "--serve", *OURS[engine]]
    else:
        precision = "bf16" if "bf16" in engine else "f32"
        env.update(AVX2 if engine.endswith("avx2") else {})
        worker = [model, views, rows, columns, precision, arguments.threads]
        command = [sys.executable, "-W", "ignore", __file__, "--worker", *map(str, worker)]
    said = tempfile.TemporaryFile(mode="w+")
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said, text=True, env=env)
    process.said = said
    return process


def ask(engine, process):
    """One run of a worker; its last words when it has ended."""
    try:
        process.stdin.write("\n")
        process.stdin.flush()
        line = process.stdout.readline()
    except BrokenPipeError:
        line = ""
    if line.startswith("{"):
        return json.loads(line)
    try:
        status = process.wait(timeout=10)
    except subprocess.TimeoutExpired:
        status = None
    process.said.seek(0)
    words = process.said.read().strip().splitlines()[-15:]
    why = "still runs" if status is None else f"was ended by signal {-status}" if status < 0 else f"ended with status {status}"
    if status == -9:
        why += " (often: the system was out of memory)"
    command = " ".join(process.args)
    raise SystemExit("\n".join([f"{engine}: the worker {why} and answered {line!r}; it was started as", f"  {command}",
                                "and its last words on standard error were:", *(f"  {word}" for word in words or ["(none)"])]))


def compare(model, views, size, arguments):
    processes = {}
    try:
        processes.update((engine, start(engine, model, views, size, arguments)) for engine in arguments.engines)
        answers = {engine: [] for engine in processes}
        for round_number in range(arguments.warmups + arguments.rounds):
            for engine, process in processes.items():
                answer = ask(engine, process)
                if round_number >= arguments.warmups:
                    answers[engine].append(answer)
    finally:
        for process in processes.values():
            try:
                process.stdin.close()
            except BrokenPipeError:
                pass
            try:
                process.wait(timeout=30)
            except subprocess.TimeoutExpired:
                process.kill()
    rows = []
    for engine, runs in answers.items():
        middle = lambda key: statistics.median(run[key] for run in runs)
        beyond = max(run["peak_kb"] - run["weights_kb"] for run in runs) / 1024
        peak = max(run["peak_kb"] for run in runs) / 1024
        rows.append({"model": model, "views": views, "engine": engine, "cpu_s": middle("cpu_s"), "wall_s": middle("wall_s"),
                     "peak_mb": peak, "working_mb": beyond, "cpu_runs": [run["cpu_s"] for run in runs]})
    base = {key: row for row in rows for key in [row["engine"]]}
    for row in rows:
        ratio = lambda other: base[other]["cpu_s"] / row["cpu_s"] if other in base else float("nan")
        row["vs_f32"], row["vs_bf16"] = ratio("torch-f32"), ratio("torch-bf16")
        print(f"| {model} | {views} | {row['engine']} | {row['cpu_s']:.2f} | {row['wall_s']:.2f} | {row['vs_f32']:.2f} | "
              f"{row['vs_bf16']:.2f} | {row['working_mb']:.0f} | {row['peak_mb']:.0f} |", flush=True)
    return rows


def main():
    if sys.argv[1:2] == ["--worker"]:
        model, views, rows, columns, precision, threads = sys.argv[2:]
        return torch_worker(model, int(views), int(rows), int(columns), precision, int(threads))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ours", default="target/release/examples/time_da3")
    parser.add_argument("--models", nargs="+", default=["da3-small", "da3-base"])
    parser.add_argument("--views", nargs="+", type=int, default=[1, 4, 8, 16])
    parser.add_argument("--size", default="378x504", help="rows x columns, multiples of 14")
    parser.add_argument("--engines", nargs="+", default=DEFAULT)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--warmups", type=int, default=1, help="rounds that are not counted, before the others")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", help="where all numbers go, as JSON")
    arguments = parser.parse_args()
    if unknown := [engine for engine in arguments.engines if engine not in OURS and engine not in TORCH]:
        parser.error(f"unknown engines {unknown}; there are {[*TORCH, *OURS]}")
    if arguments.rounds < 1 or arguments.warmups < 0:
        parser.error("at least one round is needed")
    if any(engine in OURS for engine in arguments.engines) and not os.access(arguments.ours, os.X_OK):
        parser.error(f"{arguments.ours} is no program; build it first (see the head of this file)")
    size = [int(side) for side in arguments.size.split("x")]
    print("| model | views | engine | CPU s | wall s | torch f32 / this | torch bf16 / this | working MB | peak MB |")
    print("|---|---|---|---|---|---|---|---|---|")
    rows = [row for model in arguments.models for views in arguments.views for row in compare(model, views, size, arguments)]
    if arguments.out:
        with open(arguments.out, "w") as out:
            json.dump({"size": size, "threads": arguments.threads, "load": os.getloadavg(), "rows": rows}, out, indent=1)


if __name__ == "__main__":
    main()
