"""Property tests try the same cases in every run; tests run side by side, so that each works on one thread."""

import os
import sys

# Compiled modules are kept, whatever the environment says: each program that a test starts would compile all anew.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Before NumPy is imported. Threads of BLAS wait for each other by spinning: beside others, for several times the work.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

from hypothesis import settings  # noqa: E402

settings.register_profile("same-cases", derandomize=True, deadline=None)
settings.load_profile("same-cases")
