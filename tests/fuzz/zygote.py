"""Commands of fgloc in forked processes: the libraries are loaded once, and each case has limits of its own."""

from __future__ import annotations

import os
import resource
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from tests.fuzz.processes import Done

_ADDRESS_SPACE = 16 << 30


def forked(work: Callable[[], int], seconds: float = 20.0) -> Done:
    """Run a function in a forked process with limits on processor time and memory; it returns its exit code.

    Its memory is what it takes beyond what this process holds when it is forked: libraries, and what ran here before.
    """
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        sys.stdout.flush()
        sys.stderr.flush()
        began, held_mb = time.monotonic(), _resident_mb()
        child = os.fork()
        if child == 0:
            _child(work, out, err, seconds)
        late = False
        while (ended := os.wait4(child, os.WNOHANG))[0] == 0:
            if time.monotonic() - began > 4.0 * seconds and not late:
                late = True
                os.kill(child, 9)
            time.sleep(0.005)
        _, status, usage = ended
        out.seek(0)
        err.seek(0)
        code, used = os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime
        texts = out.read().decode(errors="replace"), err.read().decode(errors="replace")
        return Done(code, *texts, used, usage.ru_maxrss / 1024.0 - held_mb, late or (code < 0 and used >= seconds))


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def fgloc(*arguments: object, seconds: float = 20.0) -> Done:
    """A command of fgloc in a forked process."""
    from fgloc.cli import app

    def work() -> int:
        sys.argv = ["fgloc", *map(str, arguments)]
        try:
            app(sys.argv[1:], standalone_mode=True)
        except SystemExit as end:
            return int(end.code or 0)
        return 0

    return forked(work, seconds)


def load() -> None:
    """Import what the commands import late, so that no case pays for it."""
    import fgloc.calibrate
    import fgloc.diagnosis.mistakes
    import fgloc.evaluation.report
    import fgloc.recording.info
    import fgloc.runner  # noqa: F401


def _child(work: Callable[[], int], out: BinaryIO, err: BinaryIO, seconds: float) -> None:
    code = 70
    try:
        os.dup2(out.fileno(), 1)
        os.dup2(err.fileno(), 2)
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1, int(seconds) + 1))
        resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        sys.stdout = open(1, "w", encoding="utf-8", errors="replace", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", encoding="utf-8", errors="replace", closefd=False)  # noqa: SIM115
        code = work()
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code)
