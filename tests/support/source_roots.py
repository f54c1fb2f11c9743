"""Folders of this clone that hold packages, for programs that tests start in processes of their own."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCE_ROOTS = (ROOT, ROOT / "training", ROOT / "datasets")
PYTHONPATH = os.pathsep.join(map(str, SOURCE_ROOTS))
