"""The conventions of docs/conventions.md: each has a test, and those that fit nowhere else are here."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from small_dataset import small_dataset, with_column
from valuemap.config import SimulationConfig, describe_settings
from valuemap.config.setting import declared
from valuemap.tables import Images
from valuemap.tables.read import table_from_arrow
from valuemap.tables.table import table_to_arrow

ROOT = Path(__file__).parents[1]


def test_every_convention_has_a_test() -> None:
    conventions = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    rows = [line for line in conventions.splitlines() if line.startswith("| ") and "| test |" not in line]
    sources = "\n".join(path.read_text(encoding="utf-8") for path in sorted((ROOT / "tests").glob("test_*.py")))
    defined = set(re.findall(r"^def (test_\w+)", sources, flags=re.MULTILINE))
    assert len(rows) > 15
    for row in rows:
        named = re.findall(r"`(test_\w+)`", row)
        assert named, row
        assert set(named) <= defined, row


SUFFIXES = {"m": "_m", "px": "_px", "deg": "_deg", "s": "_s", "m/s": "_mps"}


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        *((name, unit) for name, _, unit, _ in describe_settings()),
        *((setting.name, setting.unit) for setting in declared(SimulationConfig)),
    ],
)
def test_settings_carry_their_units_in_their_names(name: str, unit: str) -> None:
    if unit in SUFFIXES:
        assert name.endswith(SUFFIXES[unit])
    else:
        assert not name.endswith(tuple(SUFFIXES.values()))


def test_numbers_are_float64_in_memory() -> None:
    columns = table_to_arrow(small_dataset().images)
    for kind in (pa.float32(), pa.int16()):
        changed = with_column("tx", pa.array([1, 2, 3, 4], kind))(columns)
        assert table_from_arrow(Images, changed, source="s").cam_from_world_m.dtype == np.float64
