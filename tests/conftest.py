"""Property tests try the same cases in every run; tests run side by side, so that each works on one thread."""

import os

# Before NumPy is imported. Threads of BLAS wait for each other by spinning: beside others, for several times the work.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

from hypothesis import settings  # noqa: E402

settings.register_profile("same-cases", derandomize=True, deadline=None)
settings.load_profile("same-cases")
