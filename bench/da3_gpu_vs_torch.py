#!/usr/bin/env python3
"""Times Depth Anything 3 here against the official PyTorch code on one graphics processor, in turn, in one run.

Results of 26 November 2026 (NVIDIA H200): docs/benchmark/da3.md.

    cargo build --release -p vidar-da3 --features gpu --example time_da3 --example check
    target/release/examples/check --device gpu --precision f32 --on-demand .../small_v2_42x56_full.safetensors   # parity first
    python3 -m venv venv && venv/bin/pip install torch -r bench/requirements-da3.txt
    venv/bin/pip install --no-deps depth-anything-3==0.1.1   # da3-giant also needs: pip install evo
    venv/bin/python bench/da3_gpu_vs_torch.py --ours target/release/examples/time_da3 --out da3-gpu.json

Both sides run the network's forward pass on the same number of pixels, pixels from and depth to the machine's memory
included; weights are random on both sides (time does not depend on them). Every engine has its own process; rounds go through
the engines in turn, the first two are warm-up. Reported are medians of wall seconds, their quartiles, and the most device memory
held: for PyTorch what its allocator reserved, here the sum of buffers. Engines: torch-bf16 (autocast, head in f32, as the
official code runs), torch-f32 (TF32 off), ours-bf16, ours-f16, ours-f32.
"""
import argparse
import json
import os
import statistics
import subprocess
import sys
import time

OURS = {f"ours-{p}": ["--precision", p] for p in ("bf16", "f16", "f32")}
DEFAULT = ["torch-bf16", "torch-f32", "ours-bf16", "ours-f32"]
WARM_UP = 2


def torch_worker(model_name, views, rows, columns, precision):
    """One forward pass a line of standard input."""
    # The official code logs to standard output: answers get a channel of their own.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    import torch

    import depth_anything_3
    from depth_anything_3.cfg import create_object, load_config

    torch.manual_seed(1)
    torch.backends.cuda.matmul.allow_tf32 = False
    torch.backends.cudnn.allow_tf32 = False
    folder = list(depth_anything_3.__path__)[0]
    model = create_object(load_config(f"{folder}/configs/{model_name}.yaml")).eval().cuda()
    pixels = torch.randn(1, views, 3, rows, columns)
    for _ in sys.stdin:
        torch.cuda.synchronize()
        start = time.perf_counter()
        with torch.no_grad(), torch.autocast("cuda", torch.bfloat16, enabled=precision == "bf16"):
            depth = model(pixels.cuda())["depth"].float().cpu()
        wall = time.perf_counter() - start
        answer = {"wall_s": wall, "device_bytes": torch.cuda.max_memory_reserved(), "shape": list(depth.shape)}
        print(json.dumps(answer), file=answers, flush=True)


def start(engine, model, views, size, arguments):
    rows, columns = map(str, size)
    if engine in OURS:
        command = [arguments.ours, model, "--views", str(views), "--size", f"{rows}x{columns}", "--serve"]
        command += ["--device", arguments.device, *OURS[engine]]
    else:
        worker = [model, str(views), rows, columns, engine.removeprefix("torch-")]
        command = [sys.executable, "-W", "ignore", __file__, "--worker", *worker]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def ask(process):
    process.stdin.write("\n")
    process.stdin.flush()
    line = process.stdout.readline()
    if not line.startswith("{"):
        return None
    answer = json.loads(line)
    answer.setdefault("device_bytes", answer.get("device_peak_bytes"))
    return answer


def compare(model, views, size, arguments):
    processes = {engine: start(engine, model, views, size, arguments) for engine in arguments.engines}
    answers = {engine: [] for engine in processes}
    for round_number in range(arguments.rounds + WARM_UP):
        for engine, process in processes.items():
            answer = ask(process) if process else None
            if answer is None:
                processes[engine] = None
            elif round_number >= WARM_UP:
                answers[engine].append(answer)
    rows = []
    for engine, runs in answers.items():
        if processes[engine]:
            processes[engine].stdin.close()
            processes[engine].wait()
        if len(runs) < 2:
            print(f"| {model} | {views} | {engine} | ended | | |", flush=True)
            continue
        seconds = [run["wall_s"] for run in runs]
        low, middle, high = statistics.quantiles(seconds, n=4)
        memory = max(run["device_bytes"] or 0 for run in runs) / 2**30
        rows.append({"model": model, "views": views, "engine": engine, "wall_s": middle, "quartiles": [low, high],
                     "device_gib": memory, "runs": seconds})
        print(f"| {model} | {views} | {engine} | {middle:.4f} | {low:.4f} to {high:.4f} | {memory:.2f} |", flush=True)
    return rows


def main():
    if sys.argv[1:2] == ["--worker"]:
        model, views, rows, columns, precision = sys.argv[2:]
        return torch_worker(model, int(views), int(rows), int(columns), precision)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ours", default="target/release/examples/time_da3")
    parser.add_argument("--device", default="gpu", help="gpu or gpu:N")
    parser.add_argument("--models", nargs="+", default=["da3-small", "da3-large", "da3-giant"])
    parser.add_argument("--views", nargs="+", type=int, default=[1, 16, 60])
    parser.add_argument("--size", default="378x504", help="rows x columns, multiples of 14")
    parser.add_argument("--engines", nargs="+", default=DEFAULT)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--out", help="where all numbers go, as JSON")
    arguments = parser.parse_args()
    size = [int(side) for side in arguments.size.split("x")]
    print("| model | views | engine | wall s | quartiles | device GiB |")
    print("|---|---|---|---|---|---|")
    rows = [row for model in arguments.models for views in arguments.views for row in compare(model, views, size, arguments)]
    if arguments.out:
        with open(arguments.out, "w") as out:
            json.dump({"size": size, "rows": rows}, out, indent=1)


if __name__ == "__main__":
    main()
