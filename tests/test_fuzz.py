"""Input spoiled where its structure is: every case ends in a result or in one line, never in a traceback or a panic."""

from __future__ import annotations

from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fuzzing import (
    TREES,
    Fuzz,
    core_border,
    hostile_arrays,
    must_end_well,
    settings_texts,
    spoil_bytes,
    spoil_file,
    spoil_lines,
)
from valuemap import _core
from valuemap.errors import InputError
from valuemap.readers import READERS
from valuemap.readers.detections import DETECTIONS


@pytest.fixture(scope="module")
def fuzz(tmp_path_factory: pytest.TempPathFactory) -> Fuzz:
    return Fuzz(tmp_path_factory.mktemp("fuzz"))


def test_every_reader_is_fuzzed(fuzz: Fuzz) -> None:
    names = {target.name for target in fuzz.targets}
    others = {"pictures", "ros"}  # Of files of cameras and recorders, which their own libraries take apart.
    assert {name for name in READERS if not any(target.startswith(name) for target in names)} == others
    assert {f"boxes {kind}" for kind in DETECTIONS} <= names


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(random=st.randoms(use_true_random=False))
def test_files_never_end_in_a_traceback(fuzz: Fuzz, random: Random) -> None:
    random.choice(fuzz.targets).run(random)


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(random=st.randoms(use_true_random=False))
def test_arrays_never_end_in_a_traceback(random: Random) -> None:
    hostile_arrays(random)


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(random=st.randoms(use_true_random=False))
def test_settings_never_end_in_a_traceback(random: Random) -> None:
    settings_texts(random)


@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow])
@given(random=st.randoms(use_true_random=False))
def test_the_core_never_panics(random: Random) -> None:
    core_border(random)


def test_each_function_of_the_core_is_called_with_what_it_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pins that what is behind the door is fuzzed: a call that is always refused finds nothing."""
    reached: set[str] = set()

    class Seen:
        def __getattr__(self, name: str) -> Any:
            function = getattr(_core, name)

            def called(*arguments: Any, **named: Any) -> Any:
                result = function(*arguments, **named)
                reached.add(name)
                return result

            return called if callable(function) else function

    monkeypatch.setattr("fuzzing._core", Seen())
    for seed in range(400):
        core_border(Random(seed))
    assert reached >= {
        "Rays", "partition", "vote", "merge", "unit_covariance", "see", "medians",
        "Scene", "calibrate", "misfits", "find_labels",
    }  # fmt: skip


@pytest.mark.parametrize("number", [2**16, 2**32 - 1])
def test_numbers_of_classes_end_somewhere(number: int) -> None:
    one = np.eye(3)[None]
    with pytest.raises(ValueError, match="class: expected numbers below 65536"):
        _core.Rays(one, one[:, 0], np.zeros(1, np.uint32), np.array([number], np.uint32), one, one[:, 0])


def test_votes_are_sought_within_a_range_that_is_one() -> None:
    one = np.eye(3)[None]
    of_one = np.zeros(1, np.uint32)
    rays = _core.Rays(one, one[:, 2], of_one, of_one, one, one[:, 0])
    good: dict[str, Any] = {
        "max_reprojection_error_px": 6.0, "min_parallax_rad": 0.02, "min_range_m": 2.0, "max_range_m": 60.0,
        "min_vote_ratio": 0.1, "min_votes": 3, "threads": 1, "progress": lambda *_: None,
    }  # fmt: skip
    assert len(_core.vote(rays, of_one, **good)[0]) == 0
    for ranges in ({"max_range_m": 1e-320}, {"max_range_m": 1e7}, {"min_range_m": 60.0}, {"min_range_m": -1.0}):
        with pytest.raises(ValueError, match="expected 0 <= min_range_m < max_range_m"):
            _core.vote(rays, of_one, **(good | ranges))


def test_what_the_fuzzer_lets_pass_and_what_not() -> None:
    def refuse() -> None:
        raise InputError("a\nb", hint="c")

    assert must_end_well(refuse) is None  # An error writes line breaks out.
    with pytest.raises(ZeroDivisionError):
        must_end_well(lambda: 1 // 0)
    assert len({spoil_lines(Random(seed), "a,b\n1,2\n3,4") for seed in range(50)}) > 20
    assert len({spoil_bytes(Random(seed), bytes(40)) for seed in range(50)}) > 20


def test_a_case_depends_on_its_seed_alone() -> None:
    def spoiled() -> list[bytes]:
        return [spoil_file(Random(seed), "a.json", b'{"a": [1, {"b": [2]}], "c": {"d": 3}}') for seed in range(2000)]

    trees = repr(TREES)
    first = spoiled()
    assert repr(TREES) == trees
    assert spoiled() == first
