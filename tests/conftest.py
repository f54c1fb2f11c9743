"""One thread per process: many small problems, tests in parallel. Set before numpy or torch is imported.

Programs that tests start import the packages of this clone too, whichever is installed.
"""

import os

from source_roots import PYTHONPATH

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
os.environ["PYTHONPATH"] = os.pathsep.join([PYTHONPATH, *filter(None, [os.environ.get("PYTHONPATH")])])
