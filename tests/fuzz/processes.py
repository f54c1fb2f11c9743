"""A command in a process of its own, with limits on memory and time."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_PYTHONPATH = os.pathsep.join(str(ROOT / name) for name in (".", "training", "datasets"))
_ADDRESS_SPACE = 8 << 30  # of a process, most of which libraries reserve and never touch


@dataclass(frozen=True)
class Done:
    """How a process ended."""

    code: int  # negative: killed by this signal
    stdout: str
    stderr: str
    seconds: float  # processor time
    peak_mb: float
    timed_out: bool

    def failures(self, codes: Sequence[int] = (0, 1, 3), peak_mb: float = 1000.0) -> list[str]:
        """What a user should never see."""
        found = ["hangs"] if self.timed_out else []
        if not found and self.code not in codes:
            found.append(f"exit code {self.code}")
        if "Traceback" in self.stderr:
            found.append("traceback: " + self.stderr.strip().splitlines()[-1])
        if self.peak_mb > peak_mb:
            found.append(f"{self.peak_mb:.0f} MB")
        return found


_LAUNCHER = """
import os, resource, subprocess, sys
code = subprocess.call(sys.argv[2:])
used = resource.getrusage(resource.RUSAGE_CHILDREN)
with open(sys.argv[1], "w") as file:
    file.write(f"{code} {used.ru_utime + used.ru_stime} {used.ru_maxrss}")
"""


def run(arguments: Sequence[str], seconds: float = 20.0) -> Done:
    """Run ``python ARGUMENTS``; it is killed after this much processor time, or three times as much on the wall.

    A small process starts it: the peak memory of a process counts from that of the one which forked it.
    """

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1, int(seconds) + 1))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    environment = os.environ | {"PYTHONPATH": _PYTHONPATH, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        ended = Path(folder) / "ended"
        process = subprocess.Popen(
            [sys.executable, "-S", "-c", _LAUNCHER, str(ended), sys.executable, *arguments],
            stdout=out,
            stderr=err,
            stdin=subprocess.DEVNULL,
            preexec_fn=limit,
            env=environment,
            cwd=tempfile.gettempdir(),
            start_new_session=True,
        )
        try:
            process.wait(3.0 * seconds)
            late = False
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            late = True
        code, used, peak_kb = ended.read_text().split() if ended.exists() else (process.returncode, 0.0, 0.0)
        out.seek(0)
        err.seek(0)
        return Done(
            int(code),
            out.read().decode(errors="replace"),
            err.read().decode(errors="replace"),
            float(used),
            float(peak_kb) / 1024.0,
            late or (int(code) < 0 and float(used) >= seconds),
        )


def fgloc(*arguments: object, seconds: float = 20.0) -> Done:
    """Run a command of fgloc."""
    return run(["-m", "fgloc.cli", *map(str, arguments)], seconds)
