"""The accuracy statement: how far labels lie from check points, in the words and measures that surveyors use.

A check point is a true object that is matched with a label, and an error is the position of the label less that of the
object. Sources: ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2 (2023), which adds the check
points' own error and no longer gives figures for 95 %; FGDC-STD-007.3-1998 (NSSDA), which does.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from valuemap.arrays import Bools, Floats
from valuemap.dataset import Frame
from valuemap.errors import SettingError
from valuemap.evaluate.figures import is_number, to_json
from valuemap.evaluate.matching import Matches
from valuemap.tables import Labels
from valuemap.tables.covariance import covariance_matrices

MIN_CHECK_POINTS = 30
"""Of ASPRS, Edition 2."""
MIN_CHECK_POINTS_NSSDA = 20
MAX_BIAS_SHARE = 0.25
"""ASPRS, Edition 2: a mean error beyond this share of the RMSE calls for an explanation."""
MIN_STANDARD_ERRORS = 3.0
"""A mean error of fewer standard errors may be chance."""
MIN_ERROR_M = 0.005
"""A smaller error is none in whole centimetres: nothing is said of it."""
NSSDA_HORIZONTAL = 1.7308
NSSDA_VERTICAL = 1.9600
MIN_CIRCULARITY = 0.6
"""NSSDA: where the RMSE of one axis is a smaller share of the other, no factor is given. Its factor is that of like
axes."""
_CHI2_95_OF_2 = -2.0 * math.log(0.05)
_CHI2_50_OF_2 = -2.0 * math.log(0.5)
_CHI2_95_OF_1 = 3.841458820694124


@dataclass(frozen=True)
class PositionalAccuracy:
    """Errors at the check points in metres; NaN where there is nothing to measure, e.g. no heights.

    RMSE_H, RMSE_V and RMSE_3D contain the check points' own error: RMSE_H² = rmse_east² + rmse_north² + 2 sigma²,
    RMSE_V² = rmse_up² + sigma², RMSE_3D² = RMSE_H² + RMSE_V². NSSDA's figures are of the errors as they are.
    East and north are those of `Frame.east_north` where the frame is not geo-referenced. The shares count errors
    within the region that a label's covariance, with the check point's variance added, says holds 95 %: the absolute
    covariance where there is one, but less bias that against the labels around, as what all share is taken out.
    """

    check_points: int
    truth_sigma_m: float | None
    rmse_h_m: float
    rmse_v_m: float
    rmse_3d_m: float
    nssda_horizontal_95_m: float
    nssda_vertical_95_m: float
    rmse_east_m: float
    rmse_north_m: float
    rmse_up_m: float
    bias_east_m: float
    bias_north_m: float
    bias_up_m: float
    sigma_east_m: float
    """Standard deviation about the bias."""
    sigma_north_m: float
    sigma_up_m: float
    in_95_ellipse: float
    in_95_ellipse_less_bias: float
    in_95_height: float
    in_95_height_less_bias: float
    stated_sigma_factor: float
    """What stated horizontal sigmas must be multiplied by to agree with the median of the errors less bias.

    NaN where half of the labels or more state none: no factor makes anything of zero.
    """
    is_shift_stated: bool
    """Whether labels state how far all of them may be off together."""

    def to_json(self) -> dict[str, int | float | None]:
        """Return the figures by name, None where there is nothing to measure."""
        return to_json(dataclasses.asdict(self))

    @property
    def statement(self) -> str:
        """One sentence to quote."""
        if self.check_points == 0:
            return "no check points"
        own = "own error not stated" if self.truth_sigma_m is None else f"own sigma {self.truth_sigma_m:g} m an axis"
        figures = {"RMSE_H": self.rmse_h_m, "RMSE_V": self.rmse_v_m, "RMSE_3D": self.rmse_3d_m}
        told = ", ".join(f"{name} = {value:.3f} m" for name, value in figures.items() if not math.isnan(value))
        return (
            f"tested at {self.check_points} check points ({own}): {told} "
            "(measures of ASPRS Positional Accuracy Standards, Edition 2, 2023)"
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the figures must know."""
        if self.check_points == 0:
            return ()
        return tuple(note for note in (self._few(), self._shift(), self._oblong(), self._no_sigmas()) if note)

    def _few(self) -> str | None:
        if self.check_points >= MIN_CHECK_POINTS:
            return None
        nssda = f", NSSDA {MIN_CHECK_POINTS_NSSDA}" if self.check_points < MIN_CHECK_POINTS_NSSDA else ""
        return (
            f"{_counted(self.check_points, 'check point')}: too few for an accuracy statement "
            f"(ASPRS asks for at least {MIN_CHECK_POINTS}{nssda})"
        )

    def _shift(self) -> str | None:
        told = []
        for bias, sigma, rmse, names in (
            (self.bias_east_m, self.sigma_east_m, self.rmse_east_m, ("east", "west")),
            (self.bias_north_m, self.sigma_north_m, self.rmse_north_m, ("north", "south")),
            (self.bias_up_m, self.sigma_up_m, self.rmse_up_m, ("up", "down")),
        ):
            is_sure = abs(bias) > MIN_STANDARD_ERRORS * sigma / math.sqrt(self.check_points)
            if is_sure and abs(bias) > MAX_BIAS_SHARE * rmse and abs(bias) >= MIN_ERROR_M:
                told.append(f"{abs(bias):.2f} m {names[bias < 0.0]}")
        if not told:
            return None
        stated = "absolute covariances allow for one" if self.is_shift_stated else "no covariance tells it"
        return f"the labels are shifted against the truth, {', '.join(told)} on average: {stated}"

    def _oblong(self) -> str | None:
        low, high = sorted((self.rmse_east_m, self.rmse_north_m))
        is_few = self.check_points < MIN_CHECK_POINTS_NSSDA
        if is_few or high < MIN_ERROR_M or low >= MIN_CIRCULARITY * high:
            return None
        return (
            f"NSSDA's horizontal figure supposes like errors east and north: here {self.rmse_east_m:.3f} m "
            f"and {self.rmse_north_m:.3f} m"
        )

    def _no_sigmas(self) -> str | None:
        if self.check_points < 2 or not math.isnan(self.stated_sigma_factor):
            return None
        return (
            "stated_sigma_factor is not told: half of the matched labels or more state a horizontal covariance of zero"
        )


def check_truth_sigma(truth_sigma_m: float | None) -> None:
    """Refuse a standard deviation of true positions, in metres, that is negative or no number (`SettingError`)."""
    if truth_sigma_m is not None and not (is_number(truth_sigma_m) and truth_sigma_m >= 0.0):
        raise SettingError(
            f"truth_sigma: expected at least 0 m, found {truth_sigma_m!r}",
            hint="give the standard deviation of the true positions on each axis, e.g. 0.02",
        )


def measure_accuracy(
    labels: Labels, matches: Matches, frame: Frame, *, truth_sigma_m: float | None = None
) -> PositionalAccuracy:
    """Measure the errors of matched labels.

    Parameters
    ----------
    truth_sigma_m
        Standard deviation of the true positions on each axis, where it is known; else that of each check point counts,
        where all state one.

    Raises
    ------
    SettingError
        `truth_sigma_m` is negative or no number.
    """
    check_truth_sigma(truth_sigma_m)
    found = matches.object_of_label >= 0
    offset = labels.position_in_world_m[found] - matches.object_in_world_m[matches.object_of_label[found]]
    enu_from_world = frame.east_north_up()
    error = offset @ enu_from_world.T
    if not matches.objects.has_height:
        error[:, 2] = np.nan
    own_m = _own_sigmas_m(matches, found, truth_sigma_m)
    of_truth_m2 = np.zeros((len(error), 1, 1)) if own_m is None else own_m[:, None, None] ** 2 * np.eye(3)
    stated_m2, relative_m2 = (
        enu_from_world @ covariance_matrices(rows[found]) @ enu_from_world.T + of_truth_m2
        for rows in (labels.stated_covariance_m2, labels.covariance_m2)
    )
    if truth_sigma_m is None and own_m is not None:
        truth_sigma_m = math.sqrt(np.mean(own_m**2))
    return _statement(error, stated_m2, relative_m2, truth_sigma_m, labels.absolute_covariance_m2 is not None)


def _own_sigmas_m(matches: Matches, found: Bools, truth_sigma_m: float | None) -> Floats | None:
    """Return the standard deviation (N) of each check point, m; None where not all are known."""
    rows = matches.object_of_label[found]
    if truth_sigma_m is not None:
        return np.full(len(rows), truth_sigma_m)
    stated_m = matches.objects.sigma_m
    if stated_m is None or not len(rows) or np.isnan(stated_m[rows]).any():
        return None
    return stated_m[rows]


def _statement(
    error_m: Floats, stated_m2: Floats, relative_m2: Floats, truth_sigma_m: float | None, is_shift_stated: bool
) -> PositionalAccuracy:
    """Return the figures of errors (N, 3) east, north and up, with both covariances (N, 3, 3), the truth's in them."""
    count, sigma = len(error_m), truth_sigma_m or 0.0
    rmse = np.sqrt(np.mean(error_m**2, axis=0)) if count else np.full(3, np.nan)
    bias = error_m.mean(axis=0) if count else np.full(3, np.nan)
    spread = error_m.std(axis=0, ddof=1) if count > 1 else np.full(3, np.nan)
    fit_h = math.hypot(rmse[0], rmse[1])
    rmse_h, rmse_v = math.hypot(fit_h, math.sqrt(2.0) * sigma), math.hypot(rmse[2], sigma)

    # One error less its own mean is 0, and tells nothing.
    less_bias = error_m - bias if count > 1 else np.full((count, 3), np.nan)
    horizontal, horizontal_less = _squared_horizontal(error_m, stated_m2), _squared_horizontal(less_bias, relative_m2)
    factor = math.sqrt(np.median(horizontal_less) / _CHI2_50_OF_2) if count else math.nan
    return PositionalAccuracy(
        check_points=count,
        truth_sigma_m=truth_sigma_m,
        rmse_h_m=_number(rmse_h),
        rmse_v_m=_number(rmse_v),
        rmse_3d_m=_number(math.hypot(rmse_h, rmse_v)),
        nssda_horizontal_95_m=_number(NSSDA_HORIZONTAL * fit_h),
        nssda_vertical_95_m=_number(NSSDA_VERTICAL * rmse[2]),
        **{f"rmse_{axis}_m": _number(rmse[i]) for i, axis in enumerate(("east", "north", "up"))},
        **{f"bias_{axis}_m": _number(bias[i]) for i, axis in enumerate(("east", "north", "up"))},
        **{f"sigma_{axis}_m": _number(spread[i]) for i, axis in enumerate(("east", "north", "up"))},
        in_95_ellipse=_share(horizontal, _CHI2_95_OF_2),
        in_95_ellipse_less_bias=_share(horizontal_less, _CHI2_95_OF_2),
        in_95_height=_share(error_m[:, 2] ** 2, _CHI2_95_OF_1 * stated_m2[:, 2, 2]),
        in_95_height_less_bias=_share(less_bias[:, 2] ** 2, _CHI2_95_OF_1 * relative_m2[:, 2, 2]),
        stated_sigma_factor=_number(factor) if math.isfinite(factor) else math.nan,
        is_shift_stated=is_shift_stated,
    )


def _squared_horizontal(error_m: Floats, covariance_m2: Floats) -> Floats:
    """Return squared Mahalanobis distances (N) in the plane; infinite where the covariance is none."""
    east, north, _ = error_m.T
    xx, xy, yy = covariance_m2[:, 0, 0], covariance_m2[:, 0, 1], covariance_m2[:, 1, 1]
    determinant = xx * yy - xy**2
    is_proper = (determinant > 0.0) & (xx > 0.0)
    squared = (yy * east**2 - 2.0 * xy * east * north + xx * north**2) / np.where(is_proper, determinant, 1.0)
    return np.where(is_proper, squared, np.inf)


def _share(squared: Floats, limit: float | Floats) -> float:
    """Return the share within the limit; NaN of nothing and of what is not known."""
    if not len(squared) or np.isnan(squared).any():
        return math.nan
    return float(np.mean(squared <= limit))


def _number(value: float) -> float:
    """Return a Python float, and always the same NaN, so that equal statements compare as equal."""
    return math.nan if math.isnan(value) else float(value)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
