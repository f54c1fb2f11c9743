"""``python -m tests.fuzz --minutes N``: mutants of recordings, models and settings until the time is over.

Each failure is printed with its seed, and its file is kept in ``--keep``: shrink it and put it into
``tests/fuzz/regressions``.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
import tempfile
import time
from pathlib import Path

from tests.fuzz.cases import Case, config_case, model_case, recording_cases
from tests.fuzz.samples import make_samples
from tests.fuzz.zygote import load


def main() -> int:
    """Run cases; exit code 1 if any failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=0.1)
    parser.add_argument("--seed", type=int, default=0, help="of the first case; the others follow")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-failures"), help="folder for what failed")
    options = parser.parse_args()
    load()
    end, count, failed = time.monotonic() + 60.0 * options.minutes, 0, 0
    with tempfile.TemporaryDirectory(prefix="fgloc-fuzz-") as folder:
        place = Path(folder)
        make_samples(place / "samples", seconds=3.0)
        recordings = recording_cases(place, itertools.count(options.seed))
        for seed in itertools.count(options.seed):
            if time.monotonic() > end:
                break
            cases: list[Case] = [config_case(place, seed), model_case(place, seed), next(recordings)]
            for case in cases:
                count += 1
                if found := case.failures:
                    failed += 1
                    print(f"{case.name}: {'; '.join(found)}", flush=True)
                    _keep(case.path, options.keep / case.name.replace(" ", "_"))
    print(f"{count} cases, {failed} failed", file=sys.stderr)
    return 1 if failed else 0


def _keep(path: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        shutil.copytree(path, target, dirs_exist_ok=True)
    else:
        shutil.copyfile(path, target.with_name(target.name + path.suffix))


if __name__ == "__main__":
    raise SystemExit(main())
