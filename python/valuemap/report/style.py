"""How all figures look, and how they are written: the same input gives the same bytes."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from valuemap.errors import OutputError
from valuemap.folders import new_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.text import Text

INK, FAINT_INK, RULE = "#2b2f33", "#6a7076", "#c9c6be"
GROUND, STREET, STREET_EDGE, TRACK = "#f4f2ec", "#ffffff", "#d3cfc4", "#c3c9d1"
# Okabe and Ito's colours, which people with any kind of colour vision can tell apart.
BLUE, ORANGE, VERMILION, GREEN = "#0072B2", "#E69F00", "#D55E00", "#009E73"
SKY, PURPLE, YELLOW, BLACK, GREY = "#56B4E9", "#CC79A7", "#C9B400", "#1a1a1a", "#8a8a8a"

DPI = 100
FORMATS = (".png", ".svg")

_SETTINGS: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # Comes with matplotlib: the same everywhere.
    "font.size": 11,
    "text.color": INK,
    "text.parse_math": False,  # Names of users may hold dollar signs.
    "axes.edgecolor": RULE,
    "axes.labelcolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 12.5,
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": "#e7e5df",
    "grid.linewidth": 0.8,
    "xtick.color": RULE,
    "ytick.color": RULE,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "svg.hashsalt": "valuemap",  # Else ids in SVG files are random.
    "svg.fonttype": "path",
    "path.simplify": True,
}


@contextmanager
def drawing() -> Iterator[None]:
    """Make figures in the style of the reports inside the block."""
    from matplotlib import rc_context  # Slow to import, and only pictures need it.

    with rc_context(_SETTINGS), warnings.catch_warnings():  # type: ignore[arg-type]
        warnings.filterwarnings("ignore", message="Glyph")  # A class may be written in letters that no font has here.
        yield


def check_format(path: Path) -> None:
    """Find out whether a picture can be written with this suffix.

    Raises
    ------
    OutputError
        It is neither .png nor .svg.
    """
    if path.suffix.lower() not in FORMATS:
        raise OutputError(
            f"{path}: cannot draw a file {f'that ends in {path.suffix}' if path.suffix else 'without a suffix'}",
            hint=f"name a file that ends in {' or '.join(FORMATS)}",
        )


def save_figure(figure: Figure, path: Path, *, force: bool = False) -> None:
    """Write a figure as PNG or SVG, as the suffix says; never half; with `force` over a file of somebody else.

    Raises
    ------
    OutputError
        The suffix is another one, or the place cannot be written.
    """
    check_format(path)
    with new_file(path, force=force) as temporary:
        temporary.write_bytes(figure_bytes(figure, path.suffix.lower()))


def figure_bytes(figure: Figure, suffix: str) -> bytes:
    """Return a figure as a PNG or SVG file, without anything that differs between two runs."""
    buffer = io.BytesIO()
    with drawing():
        if suffix == ".svg":
            figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": "valuemap"})
        else:
            figure.savefig(buffer, format="png", dpi=figure.dpi, metadata={"Software": None})
    return buffer.getvalue()


def number_of(count: int, one: str, several: str | None = None) -> str:
    """Return a number with what it counts, in the singular or the plural."""
    return f"{count:,} {one if count == 1 else several or one + 's'}"


def probability(value: float) -> str:
    """Return a probability in words of three decimals; what is nearly certain is not called certain."""
    if value > 0.9995:
        return "> 0.999"
    return "< 0.001" if 0.0 < value < 0.0005 else f"{value:.3f}"


def plain(text: Text) -> Text:
    """Return a text of which nothing is read as a formula."""
    text.set_parse_math(False)
    return text
