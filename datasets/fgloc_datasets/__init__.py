"""Loaders of public data sets into bags, the physical simulator, and small bundled recordings.

`SAMPLE` is the recording that ``fgloc demo`` runs. Importing this module loads no other library.
"""

from pathlib import Path

SAMPLE = Path(__file__).parent / "samples" / "installed_run" / "bag"
