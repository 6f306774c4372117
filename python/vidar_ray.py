"""Many recordings on a Ray cluster: `vidar plan` here, every `vidar work` as a task of Ray.

    python -m vidar_ray --retries 3 -- bags/a.bag bags/b.bag --store /shared/results --geometry da3-small

What stands after `--` goes to `vidar plan` as it is. The program `vidar` must be on every node, and recordings and store under the
same paths. Needs `pip install ray`; the module `vidar` itself is not used. Results are those of `vidar work`: docs/guides/batches.md.
"""

import argparse
import ctypes
import json
import shutil
import signal
import subprocess
import sys


def _die_with_parent():
    """On Linux: a task that Ray kills takes its process with it. One that goes on elsewhere would do no harm."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def call(program, arguments):
    """Runs `vidar ARGUMENTS --json` and returns its object; raises RuntimeError with what it said if it fails."""
    command = [program, *arguments, "--json", "-q"]
    ended = subprocess.run(command, capture_output=True, text=True, preexec_fn=_die_with_parent)
    if ended.returncode != 0:
        said = ended.stderr.strip() or f"ended with {ended.returncode}"
        raise RuntimeError(f"{' '.join(command)}: {said}")
    return json.loads(ended.stdout)


def work(program, plan, stage, index, threads, *_after):
    """One task. `_after` are the results that it waits for; what they hold lies in the store."""
    number = ["--stage", stage, "--index", str(index), "--threads", str(threads)]
    return call(program, ["work", "--plan", plan, *number])


class Batch:
    """A plan on a cluster that `ray.init` has connected to.

    cpus, memory: what each task reserves (processors, bytes); gpus: what each task of `predict` reserves; retries: how often a task is
    tried again after an error, or after the node or process that it ran on died. A recording that cannot be mapped is a result and
    is not tried again.
    """

    def __init__(self, planned, program="vidar", cpus=1, gpus=0, memory=None, retries=3):
        import ray

        # Nodes need the program, not this file.
        ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
        self.planned, self.program, self.threads = planned, program, max(1, int(cpus))
        options = {"num_cpus": cpus, "max_retries": retries, "retry_exceptions": True}
        if memory:
            options["memory"] = memory
        self.ray = ray
        self.task = ray.remote(work).options(**options)
        self.predicting = ray.remote(work).options(**options, num_gpus=gpus)

    def _start(self, stage, index, *after):
        task = self.predicting if stage == "predict" else self.task
        return task.remote(self.program, self.planned["plan"], stage, index, self.threads, *after)

    def run(self, said=print):
        """Does all of it. Returns the table of `vidar work --stage report`, and the recordings whose tasks did not end, with the reason.

        said: called with a line for each recording that is done.
        """
        maps, unfinished = {}, {}
        parts = self.planned["parts"]
        for i, recording in enumerate(self.planned["recordings"]):
            tracked = self._start("track", i)
            predicted = [self._start("predict", i * parts + part, tracked) for part in range(parts)]
            maps[self._start("map", i, *predicted)] = recording["name"]
        waiting = list(maps)
        while waiting:
            ready, waiting = self.ray.wait(waiting)
            for name, made in ((maps[r], r) for r in ready):
                try:
                    record = self.ray.get(made)["task"]
                    said(f"{name}: {record['status']}, {record['cost']['seconds']:.1f} s for its map")
                except self.ray.exceptions.RayError as error:
                    unfinished[name] = str(error)
                    said(f"{name}: not finished: {error}")
        table = self.ray.get(self._start("report", 0))
        return table, unfinished


def main(arguments=None):
    """The command line; returns the exit status: 0 if every recording has a result, be it that it cannot be mapped."""
    parser = argparse.ArgumentParser(prog="vidar_ray", description=__doc__.splitlines()[0])
    parser.add_argument("--address", help="of the cluster; default: RAY_ADDRESS, else processes on this computer")
    parser.add_argument("--program", default=shutil.which("vidar") or "vidar", help="vidar on every node")
    parser.add_argument("--cpus", type=float, default=1, help="processors for each task")
    parser.add_argument("--gpus", type=float, default=0, help="graphics processors for each task of predict")
    parser.add_argument("--memory-gib", type=float, help="memory for each task")
    parser.add_argument("--retries", type=int, default=3, help="of a task whose node died or that failed")
    parser.add_argument("plan", nargs="+", help="after --: recordings and flags of vidar plan")
    given = parser.parse_args(arguments)
    import ray

    planned = call(given.program, ["plan", *given.plan])
    ray.init(address=given.address, log_to_driver=False)
    memory = int(given.memory_gib * 2**30) if given.memory_gib else None
    batch = Batch(planned, given.program, given.cpus, given.gpus, memory, given.retries)
    table, unfinished = batch.run(lambda line: print(line, file=sys.stderr))
    print(f"{planned['plan']}\n{table['folder']}/report.md\n{json.dumps(table['counts'])}")
    return 1 if unfinished else 0


if __name__ == "__main__":
    sys.exit(main())
