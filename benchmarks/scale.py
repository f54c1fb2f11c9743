"""``python -m benchmarks.scale``: start-up, batches of long recordings, and what an hour of a robot costs.

cli.help_s_over_import   ``fgloc --help`` over ``import numpy, typer``, each in a process of its own, processor time
cli.info_s_over_read     ``fgloc info`` of a bundled sample over reading its events once with fgloc's reader; likewise
cli.info_s_over_rosbags  over decoding its messages with rosbags alone
batch.1e5_s_over_gtsam   smoothing 10⁵ keyframes, once they were replayed, over bare GTSAM on the same factors: making
                         them, Levenberg-Marquardt from the same values, covariances of all poses
batch.1e5_s_over_ordered the same over bare GTSAM that is given fgloc's order of elimination instead of its own
batch.1e5_gb             largest memory of that, the replayed run included
batch.growth             time per keyframe with 10⁵ over that with 10⁴
hour.COMMAND.*           processor seconds, memory and bytes read and written per hour of a robot's recording
sweep.WHERE.*            wall and processor seconds of an ablation's run, with one and two workers, and over TCP
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import gtsam
import numpy as np

from benchmarks.common import ROOT, SAMPLES, Row, main
from benchmarks.steps import Chain, World
from fgloc import se2
from fgloc.graph.batch import BatchSmoother, elimination_order, solved, values_at, with_deep_stack
from fgloc.graph.factors import INSTALLATION, LandmarkFactors, pose_key, sighting_factors
from fgloc.graph.measurement_log import Keyframe, MeasurementLog, PoseWithCovariance

_SAMPLE = SAMPLES / "first_run"
_HOUR_S = 3600.0
_LAP_S = 30.0  # of the recording that a long one is made of
_READ = """\
from pathlib import Path
from fgloc.config import RecordingConfig
from fgloc.recording.reader import Recording
with Recording(Path({0!r}), RecordingConfig()) as recording:
    for event in recording.events(): pass
"""
_ROSBAGS = """\
from pathlib import Path
from rosbags.highlevel import AnyReader
with AnyReader([Path({0!r})]) as reader:
    for connection, _, raw in reader.messages(): reader.deserialize(raw, connection.msgtype)
"""
_COMMAND = "import sys; from fgloc.cli import main; sys.argv = {0!r}; main()"


def measure(quick: bool) -> Iterator[Row]:
    """Rows of the benchmark; a quick run has a tenth of the keyframes."""
    yield from _start_up(3 if quick else 9)
    yield from _hours()
    yield from _sweeps()
    # The last: the largest memory of a process that is started is at least that of the one that starts it
    yield from _batch(1_000 if quick else 10_000, 10_000 if quick else 100_000)


# --- start-up


def _start_up(times: int) -> Iterator[Row]:
    """Medians of several processes, the kinds taking turns."""
    bag = str(_SAMPLE / "bag")
    scripts = {
        "import": "import numpy, typer",
        "help": _COMMAND.format(["fgloc", "--help"]),
        "read": _READ.format(bag),
        "rosbags": _ROSBAGS.format(bag),
        "info": _COMMAND.format(["fgloc", "info", bag]),
    }
    seconds: dict[str, list[float]] = {name: [] for name in scripts}
    with tempfile.TemporaryDirectory(prefix="fgloc-scale-") as cache:  # compiled once, as of an installed package
        for k in range(times + 1):
            for name, script in scripts.items():
                taken = _processor_s([sys.executable, "-c", script], cache)[0]
                if k:
                    seconds[name].append(taken)
    s = {name: float(np.median(sample)) for name, sample in seconds.items()}
    yield Row("cli.help_s_over_import", s["help"] / s["import"], n=times)
    yield Row("cli.info_s_over_read", s["info"] / s["read"], n=times)
    yield Row("cli.info_s_over_rosbags", s["info"] / s["rosbags"], n=times)


def _processor_s(command: Sequence[str], cache: str) -> tuple[float, float]:
    """Processor seconds and largest memory [GB] of a process and its children."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment |= {"PYTHONPYCACHEPREFIX": cache, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=environment, cwd=ROOT)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 3):
        raise subprocess.CalledProcessError(process.returncode, command)
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1e6


# --- batch


def _batch(few: int, many: int) -> Iterator[Row]:
    per_keyframe = {}
    for count in (few, many):
        log, chain = long_log(count)
        factors, config = chain.localizer.factors, chain.config
        start = time.process_time()
        solver = BatchSmoother(log, factors, config.batch, config.estimator.gate_probability)
        solver.result(), solver.installed(), solver.cost()
        ours_s = time.process_time() - start
        gigabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        per_keyframe[count] = ours_s / count
        bare = _bare(solver, factors)
        label = f"batch.1e{round(np.log10(count))}"
        yield Row(f"{label}_s", ours_s, n=count, unit="s")
        yield Row(f"{label}_s_over_gtsam", ours_s / bare["gtsam"], n=count)
        yield Row(f"{label}_s_over_ordered", ours_s / bare["ordered"], n=count)
        yield Row(f"{label}_gb", gigabytes, n=count, unit="GB")
    yield Row("batch.growth", per_keyframe[many] / per_keyframe[few])


def long_log(count: int) -> tuple[MeasurementLog, Chain]:
    """The log of a robot that drives one lap, as it was replayed, again and again."""
    chain = Chain(World(), with_model=False, keep_all=True)
    for _ in chain.updates(World().events(_LAP_S)):
        pass
    lap = list(chain.localizer.estimator.log.keyframes.values())
    again = replace(lap[1].motions[0], motion=se2.between(lap[-1].belief.pose, lap[0].belief.pose), depends_on={})
    log = MeasurementLog(chain.config.estimator.lag_s, keep_all=True)
    for k in range(count):
        laps, i = divmod(k, len(lap))
        frame = lap[i]
        later_s = laps * (_LAP_S + 0.05)
        log.keyframes[k] = Keyframe(
            k,
            frame.stamp_ns + round(later_s * 1e9),
            frame.elapsed_s + later_s,
            PoseWithCovariance(frame.belief.pose, frame.belief.cov),
            prior=frame.prior if k == 0 else None,
            motions=(again,) if i == 0 and k else frame.motions,
            sightings=frame.sightings,
        )
    return log, chain


def _bare(solver: BatchSmoother, factors: LandmarkFactors) -> dict[str, float]:
    """Processor seconds of GTSAM: a graph of ready factors, one optimization, and all covariances.

    In its own order of elimination, and in fgloc's.
    """
    frames, poses, theta = solver.frames, solver.poses(), solver.installed().mean
    values = values_at(frames, [frame.belief.pose for frame in frames], solver.accepted, factors)
    graph = gtsam.NonlinearFactorGraph()
    added_s = _added(graph, solver.factors_of_motion())
    prior = factors.installation.prior()
    noise = gtsam.noiseModel.Gaussian.Covariance(prior.cov)
    added_s += _added(graph, [gtsam.PriorFactorVector(INSTALLATION, prior.mean, noise)])
    for frame, pose in zip(frames, poses, strict=True):
        if frame.sightings:
            lines = factors.observe([s.measurement for s in frame.sightings]).together(pose, theta)
            added_s += _added(graph, sighting_factors(frame.k, frame.sightings, lines, pose, theta))
    ours = elimination_order(frames, factors.installation.constants)
    orders: dict[str, gtsam.Ordering | None] = {"gtsam": None, "ordered": ours}
    return {
        name: added_s + with_deep_stack(partial(_solved_s, graph, values, len(frames), ordering))
        for name, ordering in orders.items()
    }


def _solved_s(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, count: int, ordering: gtsam.Ordering | None
) -> float:
    """Processor seconds of one optimization and the covariances of so many poses."""
    start = time.process_time()
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType("SEQUENTIAL_CHOLESKY")
    params.setRelativeErrorTol(1e-7)
    if ordering is not None:
        params.setOrdering(ordering)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    solution = gtsam.Marginals(graph, found) if ordering is None else solved(graph, found, ordering)
    for k in range(count):
        solution.marginalCovariance(pose_key(k))
    return time.process_time() - start


def _added(graph: gtsam.NonlinearFactorGraph, factors: Iterable[gtsam.NonlinearFactor]) -> float:
    """Add factors; processor seconds of adding alone."""
    made = list(factors)
    start = time.process_time()
    for factor in made:
        graph.add(factor)
    return time.process_time() - start


# --- an hour of a robot


def _hours() -> Iterator[Row]:
    """Rows of the bundled sample, a minute of a robot with camera, IMU and odometry, scaled to an hour."""
    bag = _SAMPLE / "bag"
    read_bytes = sum(file.stat().st_size for file in bag.iterdir())
    seconds = 60.0
    with tempfile.TemporaryDirectory(prefix="fgloc-scale-") as folder:
        for command in ("smooth", "online"):
            out = Path(folder) / command
            arguments = ["fgloc", command, str(bag), "--out", str(out)]
            used_s, gigabytes = _processor_s([sys.executable, "-c", _COMMAND.format(arguments)], folder)
            written = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
            yield Row(f"hour.{command}_cpu_s", used_s * _HOUR_S / seconds, unit="s/h")
            yield Row(f"hour.{command}_gb", gigabytes, unit="GB")
            yield Row(f"hour.{command}_written_mb", written / 1e6 * _HOUR_S / seconds, unit="MB/h")
    yield Row("hour.read_mb", read_bytes / 1e6 * _HOUR_S / seconds, unit="MB/h")


_SUITE = """\
title: Images lost
mode: online
recordings:
  - {{name: first_run, bag: {0}/bag}}
failures:
  - name: images lost
    chain: [{{kind: dropout, sensor: camera, when: {{share: 0.1}}}}]
    severity: {{field: when.share, values: [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]}}
"""


def _sweeps() -> Iterator[Row]:
    """Eight runs of one recording with one and two workers, and with two that a scheduler on loopback has."""
    with tempfile.TemporaryDirectory(prefix="fgloc-scale-") as folder:
        suite = Path(folder) / "suite.yaml"
        suite.write_text(_SUITE.format(_SAMPLE))
        for where in ("1_worker", "2_workers", "2_over_tcp"):
            out = Path(folder) / where
            with _cluster(Path(folder)) if where == "2_over_tcp" else nullcontext("") as address:
                more = ["--scheduler", address] if address else ["--workers", where[0]]
                script = _COMMAND.format(["fgloc", "ablate", str(suite), "--out", str(out), *more])
                start = time.perf_counter()
                _processor_s([sys.executable, "-c", script], folder)
                wall_s = time.perf_counter() - start
            costs = [json.loads(file.read_text())["cost"] for file in (out / "jobs").glob("*.json")]
            n, cpu_s = len(costs), sum(cost["cpu_s"] for cost in costs)
            yield Row(f"sweep.{where}.wall_s", wall_s / n, n=n, unit="s/run")
            yield Row(f"sweep.{where}.cpu_s", cpu_s / n, n=n, unit="s/run")
            yield Row(f"sweep.{where}.peak_gb", max(cost["peak_mb"] for cost in costs) / 1e3, n=n, unit="GB")


@contextmanager
def _cluster(folder: Path) -> Iterator[str]:
    """Address of a Dask scheduler on loopback with two workers."""
    file = folder / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    commands = [[*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]]
    commands += [[*dask, "worker", "--nthreads", "1", "--host", "127.0.0.1", "--no-dashboard"] for _ in range(2)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with ExitStack() as stack:
        for command in commands:
            quiet = subprocess.DEVNULL
            arguments = [*command, "--scheduler-file", str(file)]
            process = subprocess.Popen(arguments, cwd=folder, env=environment, stdout=quiet, stderr=quiet)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            while not file.exists() and process.poll() is None:
                time.sleep(0.1)
        yield json.loads(file.read_text())["address"]


if __name__ == "__main__":
    main(measure, __doc__.splitlines()[0])
