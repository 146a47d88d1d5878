"""The figures of the report: axes with units, readable in print and by people with any colour vision."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from valuemap.arrays import Floats
from valuemap.evaluate import Evaluation
from valuemap.evaluate.reliability import LIMITS, ExistenceRange
from valuemap.evidence import Evidence
from valuemap.experiment import CURVES, PassesResult
from valuemap.map_folder import Map
from valuemap.report.style import BLUE, DPI, FAINT_INK, GREEN, GREY, INK, ORANGE, VERMILION, drawing, figure_bytes
from valuemap.tables.covariance import covariance_matrices

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH_IN = 10.0
_LEAST_IN_BIN = 20
_DEPTH_BINS = 14
_Z95 = 1.959963984540054


@dataclass(frozen=True, eq=False)
class ReportFigure:
    """A figure of the report: `name` is that of its files, `caption` says what is to be seen."""

    name: str
    title: str
    caption: str
    figure: Figure
    _drawn: dict[str, bytes] = field(default_factory=dict, repr=False)

    def file(self, suffix: str) -> bytes:
        """Return the figure as a file, .png or .svg; drawn once."""
        if suffix not in self._drawn:
            self._drawn[suffix] = figure_bytes(self.figure, suffix)
        return self._drawn[suffix]


def _figure(panels: int, height_in: float = 3.6, *, width_in: float = _WIDTH_IN) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained", facecolor="white")
    return figure, list(np.atleast_1d(figure.subplots(1, panels)))


def _explain(figure: Figure, axes: Axes) -> None:
    """Say above all panels what the marks of one mean: inside, curves would run through the words."""
    handles, _ = axes.get_legend_handles_labels()
    figure.legend(handles=handles, loc="outside upper right", ncols=len(handles))


def residuals_by_depth(evidence: Evidence) -> ReportFigure | None:
    """Draw how large residuals are at which distance, in pixels and in sigmas; None without votes."""
    votes, labels = evidence.result.votes, evidence.result.labels
    if len(votes) < 2:
        return None
    label_row = np.searchsorted(labels.label_id, votes.label_id)
    depth = np.linalg.norm(
        evidence.center_in_world_m[evidence.image_row] - labels.position_in_world_m[label_row], axis=1
    )
    with drawing():
        figure, (in_px, in_sigmas) = _figure(2)
        for axes, values, unit in ((in_px, votes.residual_px, "px"), (in_sigmas, votes.residual_sigmas, "sigmas")):
            middle, low, median, high, most = _by_bin(depth, values)
            axes.fill_between(middle, low, high, color=BLUE, alpha=0.2, linewidth=0, label="half of the votes")
            axes.plot(middle, median, color=BLUE, marker="o", markersize=4, label="median")
            axes.plot(middle, most, color=ORANGE, linestyle="--", linewidth=1.3, label="95 %")
            axes.set_xlabel("distance to the label (m)")
            axes.set_ylabel(f"residual ({unit})")
            axes.set_ylim(bottom=0.0)
            axes.set_xlim(left=0.0)
        expected = math.sqrt(2.0 * math.log(2.0))
        in_sigmas.axhline(expected, color=FAINT_INK, linewidth=0.9, linestyle=":", label="median if all is as assumed")
        _explain(figure, in_sigmas)
    return ReportFigure(
        "residuals_by_depth",
        "Residuals by depth",
        f"How far {len(votes):,} voting detections are from where their labels project, against the distance between "
        "camera and label. Errors of position show near by, errors of rotation and of detection at all distances. "
        "Sigmas are those of a detection alone, so that what is above one near by is what poses are wrong.",
        figure,
    )


def _by_bin(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return the middle of x and the quantiles 0.25, 0.5, 0.75, 0.95 of y in bins of x with equally many rows."""
    order = np.argsort(x, kind="stable")
    bins = np.array_split(order, max(1, min(_DEPTH_BINS, len(x) // _LEAST_IN_BIN)))
    middle = np.array([np.median(x[rows]) for rows in bins])
    quantiles = np.array([np.quantile(y[rows], [0.25, 0.5, 0.75, 0.95]) for rows in bins]).T
    return middle, quantiles[0], quantiles[1], quantiles[2], quantiles[3]


def existence(result: Map, evaluation: Evaluation | None) -> ReportFigure | None:
    """Draw how often labels exist of which the map says how probable that is; None where it does not say so."""
    labels = result.labels.take(result.is_there)
    if labels.existence is None or len(labels) == 0:
        return None
    of_range = np.clip(np.searchsorted(LIMITS, labels.existence, side="right") - 1, 0, len(LIMITS) - 2)
    bins = [int(b) for b in np.unique(of_range)]
    names = [f"{LIMITS[b]:g} to {LIMITS[b + 1]:g}" for b in bins]
    count = np.array([np.sum(of_range == b) for b in bins])
    ranges = None if evaluation is None else evaluation.reliability
    with drawing():
        figure, panels = _figure(1 if ranges is None else 2)
        panels[0].bar(range(len(bins)), count, color=BLUE, alpha=0.8, width=0.7)
        for i, n in enumerate(count):
            panels[0].text(i, n, f"{n:,}", ha="center", va="bottom", fontsize=9.5)
        panels[0].set_ylabel("labels")
        panels[0].margins(y=0.12)
        if ranges is not None:
            _draw_reliability(panels[1], ranges)
            _explain(figure, panels[1])
        for axes in panels:
            axes.set_xlabel("probability of existence")
            axes.set_xticks(range(len(bins)), names, fontsize=8.5, rotation=20 if len(bins) > 4 else 0)
            axes.grid(visible=False, axis="x")
    caption = "How many labels have which probability of existence."
    if ranges is not None:
        caption += (
            " On the right the share of them that are objects, with its 95 % interval, beside what the map claims: "
            "an honest map has its claims within the intervals. Duplicates count as no objects."
        )
    return ReportFigure("existence", "Reliability of existence", caption, figure)


def _draw_reliability(axes: Axes, ranges: Sequence[ExistenceRange]) -> None:
    share, low, high = [], [], []
    for each in ranges:
        n, k = each.labels, each.true_labels
        # Wilson's interval.
        middle = (k + _Z95**2 / 2) / (n + _Z95**2)
        half = _Z95 / (n + _Z95**2) * math.sqrt(k * (n - k) / n + _Z95**2 / 4)
        share.append(each.true_share)
        low.append(max(0.0, each.true_share - (middle - half)))
        high.append(max(0.0, middle + half - each.true_share))
    x = np.arange(len(ranges))
    axes.errorbar(x, share, [low, high], fmt="o", color=BLUE, capsize=4, markersize=6, label="objects among them")
    axes.plot(
        x,
        [each.mean_existence for each in ranges],
        "_",
        color=VERMILION,
        markersize=22,
        markeredgewidth=2.2,
        label="claimed, mean",
    )
    axes.set_ylim(-0.04, 1.05)
    axes.set_xlim(-0.6, len(ranges) - 0.4)
    axes.set_ylabel("share of labels")


def covariance(result: Map, evaluation: Evaluation | None) -> ReportFigure | None:
    """Draw how often objects are within the ellipsoids that claim to hold them; None with few matches or no truth."""
    if evaluation is None or evaluation.true_positives < 3:
        return None
    squared, dimensions = normalized_errors(result, evaluation)
    if len(squared) < 3:
        return None
    from scipy.stats import chi2  # Slow to import, and only this figure needs it.

    claimed = np.sort(chi2.cdf(squared, dimensions))
    share = (np.arange(len(claimed)) + 1.0) / len(claimed)
    line = np.linspace(0.0, 1.0, 101)
    band = 1.36 / math.sqrt(len(claimed))  # Kolmogorov and Smirnov's, at 95 %.
    mean = float(squared.mean())
    with drawing():
        figure, (axes, bars) = _figure(2, 4.0)
        axes.fill_between(
            line, np.clip(line - band, 0, 1), np.clip(line + band, 0, 1), color=GREY, alpha=0.18, linewidth=0,
            label="95 % of honest maps",
        )  # fmt: skip
        axes.plot(line, line, color=FAINT_INK, linewidth=0.9, linestyle=":")
        axes.step([0.0, *claimed, 1.0], [0.0, *share, 1.0], where="post", color=BLUE, linewidth=1.8, label="this map")
        axes.set_xlabel("size of the ellipsoid: share it should hold")
        axes.set_ylabel("share of objects inside")
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1)
        axes.set_aspect("equal")
        # On the side where the curve is not.
        is_below = float(np.mean(share - claimed)) < 0.0
        left, bottom, side = (0.03, 0.7, "left") if is_below else (0.97, 0.05, "right")
        axes.text(
            left, bottom, "overconfident below,\ntoo careful above the line", ha=side, fontsize=9, color=FAINT_INK
        )
        axes.legend(loc="upper left")
        top = float(np.clip(np.quantile(squared, 0.98), 3.0 * dimensions, 8.0 * dimensions))
        edges = np.linspace(0.0, top, 25).tolist()
        bars.hist(np.minimum(squared, top), edges, density=True, color=BLUE, alpha=0.75, label="this map")
        bars.plot(
            x := np.linspace(0.0, top, 200), chi2.pdf(x, dimensions), color=INK, label=f"chi², {dimensions} degrees"
        )
        bars.set_xlabel("squared error in sigmas (last bar: and more)")
        bars.set_ylabel("density")
        bars.legend()
    return ReportFigure(
        "covariance",
        "Honesty of the covariance",
        f"Of {len(squared):,} true labels the squared error in units of their covariance is {mean:.2f} on average; "
        f"{dimensions} would be right. Larger is overconfident, smaller too careful.",
        figure,
    )


def normalized_errors(result: Map, evaluation: Evaluation) -> tuple[Floats, int]:
    """Return the squared errors (N) of true labels in units of their covariance, and over how many dimensions.

    It is that in the world, as `evaluate` takes it: what the whole map is off by is in errors against a truth, too.
    """
    matches = evaluation.matches
    rows = np.flatnonzero(matches.object_of_label >= 0)
    apart = result.labels.position_in_world_m[rows] - matches.object_in_world_m[matches.object_of_label[rows]]
    full = covariance_matrices(result.labels.stated_covariance_m2[rows])
    dimensions = 3
    if not matches.objects.has_height:
        axes = result.frame.east_north()
        apart, full, dimensions = apart @ axes.T, axes @ full @ axes.T, 2
    usable = np.linalg.det(full) > 0.0
    solved = np.linalg.solve(full[usable], apart[usable, :, None])[:, :, 0]
    return np.einsum("ni,ni->n", apart[usable], solved), dimensions


def stages(result: Map) -> ReportFigure | None:
    """Draw where time and memory went; None where the record does not say so."""
    records = [
        s for s in result.run.get("stages", []) if isinstance(s, dict) and isinstance(s.get("seconds"), int | float)
    ]
    if not records:
        return None
    names = [str(record.get("stage", "?")) for record in records]
    y = np.arange(len(records))[::-1]
    with drawing():
        figure, (time, memory) = _figure(2, 1.2 + 0.38 * len(records))
        for axes, key, unit, color in (
            (time, "seconds", "s", BLUE),
            (memory, "peak_memory_mb", "MB", GREEN),
        ):
            values = np.array([float(record.get(key) or 0.0) for record in records])
            axes.barh(y, values, color=color, alpha=0.8, height=0.66)
            for place, value in zip(y, values, strict=True):
                axes.text(
                    value, place, f" {value:,.3g}" if key == "seconds" else f" {value:,.0f}", va="center", fontsize=9.5
                )
            axes.set_yticks(y, names)
            axes.margins(x=0.16)
            axes.grid(visible=False, axis="y")
            axes.set_xlabel(f"time ({unit})" if key == "seconds" else f"peak memory of the process so far ({unit})")
    total = sum(float(record["seconds"]) for record in records)
    return ReportFigure(
        "stages", "Where time and memory went", f"{total:,.3g} s in all, without reading and writing.", figure
    )


def curve_name(name: str) -> str:
    """Return what a curve measures, with its unit."""
    title, unit = CURVES[name]
    return title if unit == "1" else f"{title} ({unit})"


def passes(result: PassesResult) -> ReportFigure:
    """Draw recall, reprojection error and position error against the number of passes, as in the paper's Fig. 4."""
    with drawing():
        figure, panels = _figure(len(CURVES), 3.6, width_in=12.0)
        for axes, (name, (_, unit)) in zip(panels, CURVES.items(), strict=True):
            curve = result.curves.get(name, [])
            n = [each.passes for each in curve]
            axes.fill_between(
                n, [each.lower for each in curve], [each.upper for each in curve], color=BLUE, alpha=0.2, linewidth=0,
                label="half of the clusters",
            )  # fmt: skip
            axes.plot(n, [each.median for each in curve], color=BLUE, marker="o", markersize=5, label="median cluster")
            axes.set_xlabel("passes (clusters that have as many)")
            axes.set_ylabel(curve_name(name))
            axes.set_xticks(n, [f"{each.passes}\n({each.clusters})" for each in curve])
            if unit == "1":
                axes.set_ylim(0.0, 1.03)
            else:
                axes.set_ylim(bottom=0.0)
        _explain(figure, panels[0])
    return ReportFigure(
        "passes",
        "What more passes bring",
        f"Quartiles over the {result.clusters:,} clusters that at least {result.min_passes} passes drove through, each "
        f"with the mean of {result.seeds} random orders of its passes, against {result.reference}. The reprojection "
        "error is in the images of a pass that was left out. Few clusters have many passes: the ends of the curves are "
        "of other places. Compare Fig. 4 (a) to (d) of the paper.",
        figure,
    )
