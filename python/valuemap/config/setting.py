"""What a setting is: declared with unit, effect and range, checked by pydantic, refused in one line.

A class of settings is a frozen pydantic dataclass on top of `Settings`; each of its numbers is a `declare`. Values from
Python must be of the declared type; the texts of `--set` are read as such.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import numbers
from collections.abc import Iterable, Mapping
from typing import Any, Literal, Self

from pydantic import ConfigDict, Field, ValidationError, model_validator
from pydantic.dataclasses import dataclass
from pydantic.fields import FieldInfo
from pydantic_core import ArgsKwargs

from valuemap.errors import SettingError

Method = Literal["robust", "paper"]

LONGEST_M = 1e5
"""Nothing in the world of one map is farther apart; beyond it squares of metres swallow the metres."""
SHORTEST_M = 1e-6
"""No camera pictures anything so near."""
LARGEST_SIGMA_M = 100.0
"""What is known no better is not known."""
WIDEST_PX = 1e5
"""Wider than any picture."""
_TOO_LARGE = 2**63
"""Whole numbers from here on fit no integer of the core."""

CHECKED = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, defer_build=True)
"""How settings are checked: types are meant, names exist, numbers are finite. Built when one is made, not on import."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """One declared setting; `default` None: estimated from the data; `method` None: all methods have it."""

    name: str
    default: float | None
    unit: str
    effect: str
    low: float
    high: float
    open_low: bool
    method: Method | None
    is_whole: bool
    example: float
    """A value that makes sense: the default, where it is not estimated."""

    @property
    def shown_default(self) -> str:
        """The default as people read it."""
        return "estimated" if self.default is None else str(self.default)

    @property
    def shown_effect(self) -> str:
        """The effect, with the only method that has the setting, if there is one."""
        return f"{self.effect}{f' ({self.method})' if self.method else ''}"

    def refusal(self, value: Any) -> SettingError:
        """Return the error for a value that is no number of the kind, or out of range."""
        kind = numbers.Integral if self.is_whole else numbers.Real
        if not isinstance(value, kind) or isinstance(value, bool):
            expected = f"{'a whole number' if self.is_whole else 'a number'} ({self.unit}), found {value!r}"
        else:
            upper = f" and at most {self.high:g}" if math.isfinite(self.high) else ""
            expected = f"{'above' if self.open_low else 'at least'} {self.low:g}{upper} ({self.unit}), found {value}"
        usual = (
            "leave it away: it is estimated" if self.default is None else f"the default is {self.name}={self.default}"
        )
        return SettingError(f"{self.name}: expected {expected}", hint=usual)


def declare(
    default: float | None,
    *,
    unit: str,
    effect: str,
    low: float = 0.0,
    high: float = math.inf,
    open_low: bool = False,
    method: Method | None = None,
    example: float | None = None,
) -> Any:
    """Declare one setting: default (None: estimated from the data), unit, effect and the range that makes sense.

    `method` is the only one that has it; None for a setting of all methods. What is estimated has an `example`, a value
    that makes sense.
    """
    return Field(
        default=default,
        description=effect,
        ge=None if open_low else low,
        gt=low if open_low else None,
        le=high if math.isfinite(high) else None,
        lt=None if math.isfinite(high) else _TOO_LARGE,
        json_schema_extra={"unit": unit, "method": method, "example": default if example is None else example},
    )


@dataclass(frozen=True, config=CHECKED)
class Settings:
    """A group of settings that belong together."""

    @model_validator(mode="wrap")
    @classmethod
    def _refuse_in_one_line(cls, values: Any, check: Any) -> Self:
        if isinstance(values, ArgsKwargs):  # NumPy's numbers are numbers too.
            values = ArgsKwargs(
                tuple(map(_plain, values.args)), {k: _plain(v) for k, v in (values.kwargs or {}).items()}
            )
        try:
            checked: Self = check(values)
        except ValidationError as error:
            raise _refusal(cls, error) from None
        return checked

    def with_settings(self, assignments: Iterable[str]) -> Self:
        """Return a copy with `name=value` assignments applied, as given to `--set`.

        Raises
        ------
        SettingError
            A name that does not exist; a value that is not a number, or out of range.
        """
        changed: Self = assign({"": self}, assignments)[""]
        return changed


def declared(settings: Any) -> list[Setting]:
    """Return the settings that a class or an object declares, in order."""
    fields: dict[str, FieldInfo] = settings.__pydantic_fields__
    return [_declared(name, field) for name, field in fields.items() if isinstance(field.json_schema_extra, dict)]


def _declared(name: str, field: FieldInfo) -> Setting:
    said: Any = field.json_schema_extra
    limits = {key: getattr(limit, key) for limit in field.metadata for key in ("ge", "gt", "le") if hasattr(limit, key)}
    return Setting(
        name=name,
        default=field.default,
        unit=said["unit"],
        effect=field.description or "",
        low=limits["gt"] if "gt" in limits else limits["ge"],
        high=limits.get("le", math.inf),
        open_low="gt" in limits,
        method=said["method"],
        is_whole=field.annotation is int,
        example=said["example"],
    )


def assign(stages: Mapping[str, Settings], assignments: Iterable[str]) -> dict[str, Any]:
    """Return the stages by name, with `name=value` assignments applied to the stage that has the name."""
    changes: dict[str, dict[str, str]] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        name = name.strip()
        stage = owner_of(name, stages, f"--set {assignment}")
        if not equals:
            setting = _owners(stages)[name][1]
            raise SettingError(
                f"--set {assignment}: expected name=value", hint=f"for example --set {name}={setting.example}"
            )
        if name in changes.setdefault(stage, {}):
            raise SettingError(
                f"--set {assignment}: {name} is set twice, to {changes[stage][name]} before",
                hint="leave one of the two away",
            )
        changes[stage][name] = text.strip()
    return {stage: _from_texts(settings, changes.get(stage, {})) for stage, settings in stages.items()}


def owner_of(name: str, stages: Mapping[str, Settings], where: str) -> str:
    """Return the stage that declares a setting; `where` is what errors begin with."""
    owners = _owners(stages)
    if name not in owners:
        near = difflib.get_close_matches(name, owners, n=1)
        raise SettingError(
            f"{where}: there is no setting named {name!r}",
            hint=f"did you mean {near[0]}?" if near else f"settings are: {', '.join(sorted(owners))}",
        )
    return owners[name][0]


def _owners(stages: Mapping[str, Settings]) -> dict[str, tuple[str, Setting]]:
    return {setting.name: (stage, setting) for stage, settings in stages.items() for setting in declared(settings)}


def _from_texts(settings: Settings, texts: Mapping[str, str]) -> Settings:
    numbers_of_texts: dict[str, float] = {}
    for setting in declared(settings):
        if setting.name in texts:
            text = texts[setting.name]
            try:
                numbers_of_texts[setting.name] = int(text) if setting.is_whole else float(text)
            except ValueError:
                raise setting.refusal(text) from None
    return dataclasses.replace(settings, **numbers_of_texts)


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, numbers.Number) and hasattr(value, "item") else value


def _refusal(kind: type[Settings], error: ValidationError) -> SettingError:
    """Return what is wrong with the first setting that pydantic refuses, in one line."""
    first: Any = error.errors(include_url=False)[0]
    names = [field.name for field in dataclasses.fields(kind)]
    place = first["loc"][0]
    name = names[place] if isinstance(place, int) and place < len(names) else str(place)
    for setting in declared(kind):
        if setting.name == name:
            return setting.refusal(first["input"])
    option = f"--{name.replace('_', '-')}"  # What is no `declare` is an option of its own.
    if first["type"] == "literal_error":
        choices = first["ctx"]["expected"].replace("'", "").replace(" or ", ", ")
        return SettingError(
            f"{option}: expected one of {choices}, found {first['input']!r}", hint="leave it away for the default"
        )
    if first["type"] == "unexpected_keyword_argument":
        near = difflib.get_close_matches(name, names, n=1)
        return SettingError(
            f"{kind.__name__}: there is no setting named {name!r}",
            hint=f"did you mean {near[0]}?" if near else f"settings are: {', '.join(sorted(names))}",
        )
    return SettingError(f"{option}: {first['msg']}, found {first['input']!r}", hint="leave it away for the default")
