"""What ``make follow`` drives: six drives, a picture and a table."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from fgloc.files.atomic import atomic_folder
from fgloc_datasets.sim.following.cases import CASES, drive_of
from fgloc_datasets.sim.following.figures import draw_drives, table
from fgloc_datasets.sim.following.loop import Drive, follow
from fgloc_datasets.sim.following.poses import PoseName
from fgloc_datasets.sim.following.results import Followed
from fgloc_datasets.sim.sensors import Sees

SEED = 141  # of the benchmark's validation split
_DRIVES: tuple[tuple[str, PoseName], ...] = (
    ("flat30", "fgloc"),
    ("flat20", "fgloc"),
    ("onewheel", "fgloc"),
    ("ice", "wheels"),
    ("ice", "fgloc"),
    ("dark20", "fgloc"),
)
PICTURE, TABLE = "following.png", "following.txt"


def demonstrate(out: Path, jobs: int = 2, sees: Sees = "images") -> str:
    """Drive, draw ``following.png``, write ``following.txt``; nothing appears in ``out`` before all is done.

    Args:
        out: folder.
        jobs: processes.
        sees: what the camera sends.

    Returns:
        The table.

    Raises:
        RenderError: images are wanted and there is no OpenGL.
    """
    with ProcessPoolExecutor(min(jobs, len(_DRIVES)), get_context("spawn")) as pool:
        waiting = [pool.submit(_driven, case, pose, sees) for case, pose in _DRIVES]
        made = [job.result() for job in waiting]
    drives = {
        CASES[case].title + (", wheel odometry" if pose == "wheels" else ""): done
        for (case, pose), done in zip(_DRIVES, made, strict=True)
    }
    text = table(drives)
    with atomic_folder(out, own=(PICTURE, TABLE)) as stage:
        draw_drives(drives, stage / PICTURE)
        (stage / TABLE).write_text(text + "\n", encoding="utf-8")
    return text


def _driven(case: str, pose: PoseName, sees: Sees) -> tuple[Drive, Followed]:
    drive = drive_of(case, pose, SEED, sees)
    return drive, follow(drive)
