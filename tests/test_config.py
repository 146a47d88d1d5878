"""Settings: every default in range, every misuse refused with a hint, and the record complete."""

from __future__ import annotations

import math
import pickle
from typing import Any, cast, get_args

import numpy as np
import pytest

from valuemap.config import (
    DetectConfig,
    MapConfig,
    MergeConfig,
    PartitionConfig,
    SimulationConfig,
    TrainConfig,
    VoteConfig,
    describe_settings,
)
from valuemap.config.setting import Method, declared
from valuemap.errors import SettingError

NAMES = [name for name, *_ in describe_settings()]


def test_the_settings_of_the_paper_have_its_values() -> None:
    assert PartitionConfig().cluster_radius_m == 50.0
    assert MergeConfig().merge_radius_m == 1.0


def test_settings_go_to_the_stage_that_has_them() -> None:
    config = MapConfig(method="paper").with_settings(["max_range_m=80", " min_votes = 4 ", "merge_radius_m=0"])
    assert (config.vote.max_range_m, config.vote.min_votes, config.merge.merge_radius_m) == (80.0, 4, 0.0)
    assert config.partition == PartitionConfig()
    assert MapConfig().vote == VoteConfig()


def test_two_settings_that_only_fit_together_can_be_set_together() -> None:
    config = MapConfig().with_settings(["min_range_m=200", "max_range_m=300"])
    assert config.vote.min_range_m == 200.0


def test_as_dict_holds_every_setting_once() -> None:
    record = MapConfig().with_settings(["min_parallax_deg=3"]).as_dict()
    assert sorted(record) == sorted(["method", *NAMES])
    assert len(set(NAMES)) == len(NAMES)
    assert record["method"] == "robust"
    assert record["min_parallax_deg"] == 3.0


def test_every_setting_is_described() -> None:
    for name, default, unit, effect in describe_settings():
        assert unit
        assert len(effect) > 20
        value = MapConfig().as_dict()[name]
        assert default == ("estimated" if value is None else str(value))


@pytest.mark.parametrize(
    ("assignment", "message", "hint"),
    [
        ("max_rnage_m=80", "there is no setting named 'max_rnage_m'", "did you mean max_range_m?"),
        ("alpha=1", "there is no setting named 'alpha'", "settings are: cluster_radius_m, "),
        ("method=robust", "there is no setting named 'method'", "settings are: "),
        ("=3", "there is no setting named ''", "settings are: "),
        ("min_votes", "--set min_votes: expected name=value", "for example --set min_votes=3"),
        ("max_range_m", "--set max_range_m: expected name=value", "for example --set max_range_m=60.0"),
        ("side_sigma_m", "--set side_sigma_m: expected name=value", "for example --set side_sigma_m=0.1"),
        ("max_rnage_m", "there is no setting named 'max_rnage_m'", "did you mean max_range_m?"),
        (
            "max_range_m=far",
            r"max_range_m: expected a number \(m\), found 'far'",
            "leave it away: it is estimated",
        ),
        ("max_range_m=", r"max_range_m: expected a number \(m\), found ''", "leave it away: it is estimated"),
        (
            "min_votes=3.5",
            r"min_votes: expected a whole number \(images\), found '3.5'",
            "the default is min_votes=3",
        ),
        (
            "min_votes=1",
            r"min_votes: expected at least 2 and at most 1e\+06 \(images\), found 1",
            "the default is min_votes=3",
        ),
        (
            "cluster_radius_m=0",
            r"cluster_radius_m: expected above 0 and at most 100000 \(m\), found 0",
            "cluster_radius_m=50",
        ),
        (
            "merge_radius_m=-1",
            r"merge_radius_m: expected at least 0 and at most 100000 \(m\), found -1",
            "merge_radius_m=1",
        ),
        (
            "max_range_m=inf",
            r"max_range_m: expected at least 1e-06 and at most 100000 \(m\), found inf",
            "it is estimated",
        ),
        (
            "max_range_m=nan",
            r"max_range_m: expected at least 1e-06 and at most 100000 \(m\), found nan",
            "it is estimated",
        ),
        (
            "min_parallax_deg=91",
            r"min_parallax_deg: expected at least 0 and at most 90 \(deg\), found 91",
            "=2",
        ),
        ("min_range_m=60", r"min_range_m \(60.0\) must be less than max_range_m \(60.0\)", "set both"),
    ],
)
def test_a_wrong_assignment_is_refused(assignment: str, message: str, hint: str) -> None:
    method = MapConfig().ignored_settings().get(assignment.partition("=")[0], "robust")
    with pytest.raises(SettingError, match=message) as refusal:
        MapConfig(method=method).with_settings([assignment])
    assert hint in refusal.value.hint
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("method", get_args(Method))
def test_the_example_of_a_setting_without_a_value_is_taken(method: Method) -> None:
    config = MapConfig(method=method)
    for name in config.as_dict().keys() - config.ignored_settings() - {"method"}:
        with pytest.raises(SettingError, match=f"--set {name}: expected name=value") as refusal:
            config.with_settings([name])
        example = refusal.value.hint.removeprefix("for example --set ")
        assert example.startswith(f"{name}=")
        assert len(example) < 30
        config.with_settings([example])
    for name in config.ignored_settings():
        with pytest.raises(SettingError, match=f"--set {name}: the method {method} has no such setting"):
            config.with_settings([name])


def test_a_setting_is_set_once() -> None:
    for second in ("min_votes=5", "min_votes=4", " min_votes = 5"):
        with pytest.raises(SettingError, match=f"--set {second}: min_votes is set twice, to 4 before") as refusal:
            MapConfig().with_settings(["min_votes=4", "max_range_m=80", second])
        assert refusal.value.hint == "leave one of the two away"


def test_a_number_that_nothing_can_hold_is_refused() -> None:
    with pytest.raises(SettingError, match="min_votes: expected "):
        MapConfig().with_settings(["min_votes=1" + "0" * 400])


def test_an_unknown_method_is_refused() -> None:
    with pytest.raises(SettingError, match="method: expected one of robust, paper, found 'magic'"):
        MapConfig(method="magic")  # type: ignore[arg-type]


def test_wrong_settings_are_refused_wherever_they_come_from() -> None:
    with pytest.raises(SettingError, match="max_reprojection_error_px: expected above 0"):
        MapConfig(vote=VoteConfig(max_reprojection_error_px=0.0))


@pytest.mark.parametrize("name", [f.name for f in declared(SimulationConfig)])
def test_the_simulation_has_a_range_for_every_setting(name: str) -> None:
    for wrong in ("nan", "-1000000"):
        with pytest.raises(SettingError, match=f"{name}: expected "):
            SimulationConfig().with_settings([f"{name}={wrong}"])
    default = getattr(SimulationConfig(), name)
    assert SimulationConfig().with_settings([f"{name}={default}"]) == SimulationConfig()
    assert math.isfinite(default)


def test_settings_have_the_type_that_they_declare() -> None:
    for given in (80, 80.0, np.float32(80)):
        length = VoteConfig(max_range_m=cast("float", given)).max_range_m
        assert (length, type(length)) == (80.0, float)
    assert VoteConfig(min_votes=cast("int", np.int64(4))).min_votes == 4


@pytest.mark.parametrize(
    ("kind", "given", "line"),
    [
        (VoteConfig, {"max_range_m": "80"}, r"max_range_m: expected a number \(m\), found '80'"),
        (VoteConfig, {"min_parallax_deg": None}, r"min_parallax_deg: expected a number \(deg\), found None"),
        (VoteConfig, {"min_votes": 3.5}, r"min_votes: expected a whole number \(images\), found 3.5"),
        (VoteConfig, {"min_votes": True}, r"min_votes: expected a whole number \(images\), found True"),
        (MapConfig, {"max_range_m": "80"}, r"max_range_m: expected a number \(m\), found '80'"),
        (VoteConfig, {"max_rnage_m": 80}, "VoteConfig: there is no setting named 'max_rnage_m'"),
        (MapConfig, {"vote": 80}, "vote: expected VoteConfig, found 80"),
        (DetectConfig, {"kind": "magic"}, "--kind: expected one of segmentation, yolox, .*, found 'magic'"),
        (DetectConfig, {"provider": "tpu"}, "--provider: expected one of cpu, cuda, found 'tpu'"),
        (DetectConfig, {"size": 640}, "--size: .* string, found 640"),
    ],
)
def test_a_wrong_value_from_python_is_refused_in_one_line(kind: Any, given: dict[str, Any], line: str) -> None:
    with pytest.raises(SettingError, match=f"^{line}$") as refusal:
        kind(**given)
    assert refusal.value.hint


def test_a_wrong_value_without_its_name_is_refused_by_name() -> None:
    with pytest.raises(SettingError, match="^max_reprojection_error_px: expected above 0 "):
        VoteConfig(0.0)


@pytest.mark.parametrize("settings", [MapConfig(max_range_m=80), DetectConfig(size="640"), TrainConfig(epochs=3)])
def test_settings_travel_to_other_processes(settings: object) -> None:
    assert pickle.loads(pickle.dumps(settings)) == settings
