"""One setting: how it is declared with unit, effect and range, found by name, read from text and checked."""

from __future__ import annotations

import dataclasses
import difflib
import math
import numbers
from collections.abc import Iterable, Mapping
from dataclasses import field, fields
from typing import Any, Literal

from valuemap.errors import SettingError

Method = Literal["robust", "paper"]

LONGEST_M = 1e5
"""Nothing in the world of one map is farther apart; beyond it squares of metres swallow the metres."""
WIDEST_PX = 1e5
"""Wider than any picture."""
_TOO_LARGE = 2**63
"""Whole numbers from here on fit no integer of the core."""


def declare(
    default: float | None,
    *,
    unit: str,
    effect: str,
    low: float = 0.0,
    high: float = math.inf,
    open_low: bool = False,
    method: Method | None = None,
) -> Any:
    """Declare one setting: default (None: estimated from the data), unit, effect and the range that makes sense.

    `method` is the only one that has it; None for a setting of all methods.
    """
    return field(
        default=default,
        metadata={"unit": unit, "effect": effect, "low": low, "high": high, "open_low": open_low, "method": method},
    )


def assign(stages: Mapping[str, Any], assignments: Iterable[str]) -> dict[str, Any]:
    """Return the stages by name, with `name=value` assignments applied to the stage that has the name."""
    changes: dict[str, dict[str, float]] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        name = name.strip()
        if not equals:
            example, (_, setting) = next(iter(_owners(stages).items()))
            raise SettingError(
                f"--set {assignment}: expected name=value", hint=f"for example --set {example}={setting.default}"
            )
        stage, setting = owner_of(name, stages, f"--set {assignment}")
        changes.setdefault(stage, {})[name] = _parse(setting, text.strip())
    return {stage: dataclasses.replace(config, **changes.get(stage, {})) for stage, config in stages.items()}


def _owners(stages: Mapping[str, Any]) -> dict[str, tuple[str, dataclasses.Field[Any]]]:
    """Return the stage and the declaration of every setting by name."""
    return {s.name: (stage, s) for stage, config in stages.items() for s in fields(config) if s.metadata}


def owner_of(name: str, stages: Mapping[str, Any], where: str) -> tuple[str, dataclasses.Field[Any]]:
    """Return the stage and the declaration of one setting; `where` is what errors begin with."""
    owner = _owners(stages)
    if name not in owner:
        near = difflib.get_close_matches(name, owner, n=1)
        raise SettingError(
            f"{where}: there is no setting named {name!r}",
            hint=f"did you mean {near[0]}?" if near else f"settings are: {', '.join(sorted(owner))}",
        )
    return owner[name]


def _parse(setting: dataclasses.Field[Any], text: str) -> float:
    number = int if isinstance(setting.default, int) else float
    try:
        return number(text)
    except ValueError:
        kind = "a whole number" if number is int else "a number"
        raise SettingError(
            f"{setting.name}: expected {kind} ({setting.metadata['unit']}), found {text!r}",
            hint=f"the default is {setting.name}={shown(setting.default)}",
        ) from None


def effect_of(setting: dataclasses.Field[Any]) -> str:
    """Return the effect of a setting with the only method that has it, if there is one."""
    method = setting.metadata["method"]
    return f"{setting.metadata['effect']}{f' ({method})' if method else ''}"


def shown(value: Any) -> str:
    """Return a default as people read it."""
    return "estimated" if value is None else str(value)


def check_range(setting: dataclasses.Field[Any], value: float | None) -> None:
    """Raise `SettingError` where a value is not a number of the kind and in the range that the setting has."""
    if value is None and setting.default is None:
        return
    kind = numbers.Integral if isinstance(setting.default, int) else numbers.Real
    if not isinstance(value, kind) or isinstance(value, bool):
        expected = "a whole number" if kind is numbers.Integral else "a number"
        raise SettingError(
            f"{setting.name}: expected {expected} ({setting.metadata['unit']}), found {value!r}",
            hint=f"the default is {setting.name}={shown(setting.default)}",
        )
    low, high = setting.metadata["low"], setting.metadata["high"]
    too_low = value <= low if setting.metadata["open_low"] else value < low
    if too_low or value > high or not abs(value) < _TOO_LARGE:  # Nor infinite, nor NaN.
        above = "above" if setting.metadata["open_low"] else "at least"
        upper = f" and at most {high:g}" if math.isfinite(high) else ""
        raise SettingError(
            f"{setting.name}: expected {above} {low:g}{upper} ({setting.metadata['unit']}), found {value}",
            hint=f"the default is {setting.name}={shown(setting.default)}",
        )
