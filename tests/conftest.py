"""Property tests try the same cases in every run; tests run side by side, so that each works on one thread."""

import os
import sys

# Compiled modules are kept, whatever the environment says: each program that a test starts would compile all anew.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Before NumPy is imported. Threads of BLAS wait for each other by spinning: beside others, for several times the work.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

settings.register_profile("same-cases", derandomize=True, deadline=None)
settings.load_profile("same-cases")

LONGEST = ("test_train.py", "test_viewer_page.py")
"""Files of some minutes whose names come late: begun first, no process is left alone with one of them in the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put tests of the longest files first; else they run in the order of their names."""
    items.sort(key=lambda item: item.path.name not in LONGEST)
