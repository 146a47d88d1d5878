"""Property tests try the same cases in every run; tests run side by side, so that each works on one thread."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

# Compiled modules are kept, whatever the environment says: each program that a test starts would compile all anew.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Before NumPy is imported. Threads of BLAS wait for each other by spinning: beside others, for several times the work.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

if TYPE_CHECKING:
    from valuemap.check.fault import View
    from valuemap.dataset import Dataset

settings.register_profile("same-cases", derandomize=True, deadline=None)
settings.load_profile("same-cases")

LONGEST = ("test_train.py", "test_viewer_page.py")
"""Files of some minutes whose names come late: begun first, no process is left alone with one of them in the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put tests of the longest files first; else they run in the order of their names."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


def _city(**changes: float) -> Dataset:
    """Return the city that checks are tried on; what makes it is imported where it is asked for."""
    from check_faults import good_city

    return good_city(1, **changes)


@pytest.fixture(scope="session")
def good() -> Dataset:
    """Return a city without faults."""
    return _city()


@pytest.fixture(scope="session")
def few() -> Dataset:
    """Half as many passes: enough for all that is looked for beside a fault."""
    return _city(passes_per_street=2)


@pytest.fixture(scope="session")
def one() -> Dataset:
    """Each street is driven once: enough for what shows at once."""
    return _city(passes_per_street=1)


@pytest.fixture(scope="module")
def view(good: Dataset) -> View:
    """Return the city as checks see it. It remembers what was asked, so that each file has its own."""
    from valuemap.check.fault import View

    return View(good)
