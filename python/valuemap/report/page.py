"""The report as one HTML file: no network, no server, and without scripts it still shows tables, figures and lists.

Everything that users named (data sets, classes, images, passes) is written as text and nothing else: escaped in HTML,
and in the inline data so that no name can end the script that holds it. The page forbids itself to fetch anything.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.arrays import Floats
from valuemap.evaluate import LABEL_OUTCOMES, OBJECT_OUTCOMES, Evaluation
from valuemap.evidence import Evidence
from valuemap.map_folder import Map
from valuemap.report.errors import error_m
from valuemap.report.figures import ReportFigure
from valuemap.report.ground import ellipses, horizontal_axes, look_down, thinned
from valuemap.report.paper import Cell, ReportTable
from valuemap.report.style import BLUE, GREY, PURPLE, SKY, YELLOW
from valuemap.tables.covariance import covariance_matrices

_HERE = Path(__file__).parent
_MOST_NAMED_IMAGES = 50_000
"""With more voting images than this the page gives their rows instead of their names, which would be most of it."""
_CLASS_COLORS = (BLUE, PURPLE, SKY, YELLOW, "#7a5195", "#8c564b", GREY)
_CLASS_COLORS_ON_BLACK = (SKY, "#e39cc4", "#9be3c5", "#f0e442", "#b79ae0", "#d49a86", "#b8bec4")
_INVITATION = "Click a label. The wheel or + and - zoom, dragging or arrow keys move, n and p step from label to label."


@dataclass(frozen=True, eq=False)
class Card:
    """One listed label: its row, what is said about it, and its crops (JPEG in base64, caption)."""

    row: int
    title: str
    lines: tuple[str, ...]
    crops: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, eq=False)
class Content:
    """Everything that the page shows."""

    title: str
    summary: str
    figures_in_short: tuple[tuple[str, str], ...]
    """A value and what it is, each."""
    above: ReportFigure
    figures: tuple[ReportFigure, ...]
    tables: tuple[ReportTable, ...]
    lists: tuple[tuple[str, str, tuple[Card, ...]], ...]
    """Title, explanation and labels of each list."""
    notes: tuple[str, ...]
    data: dict[str, Any] = field(default_factory=dict)
    """What the map on the page needs when it opens."""
    details: dict[str, Any] = field(default_factory=dict)
    """What a click needs: read when the page has nothing else to do, because it is nearly all of a large map."""


def page_text(content: Content) -> str:
    """Return the page."""
    script = (_HERE / "page.js").read_text(encoding="utf-8")
    style = (_HERE / "page.css").read_text(encoding="utf-8")
    policy = (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
        f"script-src 'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"
    )
    figures = "\n".join(_figure(figure, as_png=False) for figure in content.figures)
    tables = "\n".join(_table(table) for table in content.tables)
    lists = "\n".join(_list(*each) for each in content.lists if each[2]) or "<p>The map has no labels.</p>"
    short = "".join(
        f"<li><b>{_text(value)}</b><span>{_text(what)}</span></li>" for value, what in content.figures_in_short
    )
    notes = "".join(f"<li>{_text(note)}</li>" for note in content.notes)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="generator" content="valuemap">
<title>{_text(content.title)}: valuemap report</title>
<style>{style}</style>
</head>
<body>
<header>
<h1>{_text(content.title)}</h1>
<p class="lead">{_text(content.summary)}</p>
<nav aria-label="Sections">
<a href="#labels">Labels</a><a href="#listed">Worst and doubtful</a><a href="#figures">Figures</a>
<a href="#tables">Tables</a><a href="#notes">Notes</a></nav>
<ul class="figures">{short}</ul>
</header>
<main>
<section id="labels">
<h2>Labels</h2>
<div id="explore" hidden>
<div id="tools">
<label>class <select id="class"><option value="">all</option></select></label>
<label>existence from <input id="least" type="range" min="0" max="1" step="0.01" value="0">
<span id="least-value">0.00</span></label>
<label>label <input id="search" type="search" placeholder="id"></label>
<button id="all" type="button">show all</button>
</div>
<canvas id="map" tabindex="0" role="img" aria-label="Map of all labels from above. Arrow keys move, + and - zoom,
 n and p step from label to label; the panel beside it says what the chosen label rests on."></canvas>
<aside id="panel" aria-live="polite" aria-label="The chosen label"></aside>
<div id="legend"></div>
</div>
<div id="static-map">{_figure(content.above, as_png=True)}</div>
</section>
<section id="listed"><h2>The worst and the most doubtful labels</h2>
{lists}</section>
<section id="figures"><h2>Figures</h2>
{figures}</section>
<section id="tables"><h2>Tables</h2>
<div class="all">
{tables}</div></section>
<section id="notes"><h2>Notes</h2><ul>{notes}</ul></section>
</main>
<script id="data" type="application/json">{_json(content.data)}</script>
<script id="details" type="application/json">{_json(content.details)}</script>
<script>{script}</script>
</body>
</html>
"""


# Parts of the page.


def _text(text: object) -> str:
    return html.escape(str(text), quote=True)


def _json(data: Any) -> str:
    """Return JSON that nothing in it can end or turn into markup."""
    text = json.dumps(data, ensure_ascii=True, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def shown(cell: Cell) -> str:
    """Return a cell for people: numbers with what digits are worth reading."""
    if cell is None:
        return "–"  # noqa: RUF001
    if isinstance(cell, bool) or not isinstance(cell, int | float):
        return str(cell)
    if isinstance(cell, int) or float(cell).is_integer():
        return f"{int(cell):,}"
    magnitude = abs(cell)
    return f"{cell:,.1f}" if magnitude >= 100 else f"{cell:.2f}" if magnitude >= 10 else f"{cell:.3g}"


def _table(table: ReportTable) -> str:
    columns = "".join(f'<th scope="col">{_text(name)}</th>' for name in table.columns)
    rows = "".join("<tr>" + "".join(f"<td>{_text(shown(cell))}</td>" for cell in row) + "</tr>" for row in table.rows)
    notes = "".join(f'<p class="note">{_text(note)}</p>' for note in table.notes)
    wide = " wide" if len(table.columns) > 3 else ""
    return (
        f'<div class="table{wide}"><h3>{_text(table.title)}</h3><div class="scroll">'
        f"<table><thead><tr>{columns}</tr></thead><tbody>{rows}</tbody></table></div>{notes}</div>"
    )


def _figure(figure: ReportFigure, *, as_png: bool) -> str:
    if as_png:
        data = base64.b64encode(figure.file(".png")).decode("ascii")
        picture = f'<img alt="{_text(figure.title)}" src="data:image/png;base64,{data}">'
    else:
        picture = _inline_svg(figure)
    return (
        f'<figure><h3>{_text(figure.title)}</h3><div class="sheet">{picture}</div>'
        f"<figcaption>{_text(figure.caption)}</figcaption></figure>"
    )


def _inline_svg(figure: ReportFigure) -> str:
    """Return a figure as an SVG element, with ids that no other figure of the page has."""
    text = figure.file(".svg").decode("utf-8")
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{figure.name}-', text)
    text = re.sub(r"url\(#", f"url(#{figure.name}-", text)
    text = re.sub(r'href="#', f'href="#{figure.name}-', text)
    return text.replace("<svg ", f'<svg role="img" aria-label="{_text(figure.title)}" ', 1)


def _list(title: str, explanation: str, cards: tuple[Card, ...]) -> str:
    body = "".join(_card(card) for card in cards)
    return f'<h3>{_text(title)}</h3><p class="note">{_text(explanation)}</p><div class="cards">{body}</div>'


def _card(card: Card) -> str:
    lines = "<br>".join(_text(line) for line in card.lines)
    crops = "".join(
        f'<figure><img alt="{_text(caption)}" src="data:image/jpeg;base64,{data}">'
        f"<figcaption>{_text(caption)}</figcaption></figure>"
        for data, caption in card.crops
    )
    crops = f'<div class="crops" data-label="{card.row}">{crops}</div>' if crops else ""
    button = f'<button type="button" data-show="{card.row}" hidden>show on the map</button>'
    return f'<div class="card"><b>{_text(card.title)}</b><br>{lines}{crops}<p>{button}</p></div>'


# The inline data.


def _packed(values: Any, kind: str) -> dict[str, str]:
    """Return an array as little-endian bytes in base64; `kind` is f4, f8, i2, u1, u2 or u4."""
    data = np.ascontiguousarray(values, dtype=np.dtype(f"<{kind}"))
    return {"type": kind, "data": base64.b64encode(data.tobytes()).decode("ascii")}


def inline_data(
    result: Map,
    evidence: Evidence | None,
    evaluation: Evaluation | None,
    crops: dict[int, list[tuple[str, str]]],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what the interactive part shows: for the map (`Content.data`), and for a click (`Content.details`).

    Positions are relative to an origin along right, top and up of the picture. Each vote holds its row in the table of
    cameras that voted, its direction (parts of 32,767) and its residuals.
    """
    labels = result.labels
    basis, axis_names = horizontal_axes(result.frame)
    basis = np.vstack([basis, result.frame.up])
    matches = None if evaluation is None else evaluation.matches
    ground = look_down(result, None if evidence is None else evidence.dataset, matches)
    position = labels.position_in_world_m @ basis.T
    origin = np.round(np.median(position, axis=0)) if len(position) else np.zeros(3)
    half_axes_m, angle = ellipses(labels.stated_covariance_m2, basis[:2])
    full = covariance_matrices(labels.stated_covariance_m2)
    up = np.array(result.frame.up)
    drives = [*ground.drives, *ground.joins]
    points = np.concatenate([*drives, ground.all_points(), np.empty((0, 2))])
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(2), np.ones(2))
    step = max(0.5, float(np.max(high - low)) / 6000.0)
    drives = [thinned(drive - origin[:2], step) for drive in drives]
    count = np.bincount(labels.class_name.codes, minlength=len(labels.class_name.names))
    rank = np.empty(len(count), np.int64)
    rank[np.lexsort((np.arange(len(count)), -count))] = np.arange(len(count))
    arrays = {
        "label_id": _packed(labels.label_id, "f8"),
        "label_at": _packed(position - origin, "f4"),
        "label_class": _packed(labels.class_name.codes, "u2"),
        "half_axes": _packed(half_axes_m, "f4"),
        "angle": _packed(angle, "f4"),
        "up_sigma": _packed(np.sqrt(np.maximum(np.einsum("i,nij,j->n", up, full, up), 0.0)), "f4"),
        "existence": _packed([] if labels.existence is None else labels.existence, "f4"),
        "expected": _packed([] if labels.expected is None else labels.expected, "u4"),
        "votes": _packed(labels.votes, "u4"),
        "passes": _packed(labels.passes, "u4"),
        "rms": _packed(labels.reprojection_rms_px, "f4"),
        "lon_lat": _packed([] if labels.lon_lat_height is None else labels.lon_lat_height[:, :2], "f8"),
        "label_state": _packed([] if labels.state is None else labels.state.codes, "u1"),
        "is_gone": _packed(~result.is_there, "u1"),
        "label_outcome": _packed([] if evaluation is None else evaluation.matches.label_outcome.codes, "u1"),
        "error": _packed([] if evaluation is None else error_m(result, evaluation), "f4"),
        "object_at": _packed(ground.object_points - origin[:2], "f4"),
        "object_outcome": _packed([] if evaluation is None else evaluation.matches.object_outcome.codes, "u1"),
        "drive_points": _packed(np.concatenate([*drives, np.empty((0, 2))]), "f4"),
        "drive_offsets": _packed(np.cumsum([0, *map(len, drives)]), "u4"),
    }
    assert evaluation is None or evaluation.matches.label_outcome.names == LABEL_OUTCOMES
    assert evaluation is None or evaluation.matches.object_outcome.names == OBJECT_OUTCOMES
    votes, names, passes = _votes(result, evidence, basis, origin)
    data = {
        "arrays": arrays,
        "detail_arrays": list(votes),
        "origin": origin.tolist(),
        "extent": [*(low - origin[:2]).tolist(), *(high - origin[:2]).tolist()],
        "drives": len(ground.drives),
        "axis_names": [name.removesuffix(" (m)") for name in axis_names],
        "classes": list(labels.class_name.names),
        "class_rank": rank.tolist(),
        "class_colors": [list(_CLASS_COLORS), list(_CLASS_COLORS_ON_BLACK)],
        "outcomes": list(LABEL_OUTCOMES),
        "states": [] if labels.state is None else list(labels.state.names),
        "invitation": _INVITATION,
    }
    details = {
        "arrays": votes,
        "passes": passes,
        "image_names": names,
        "crops": {str(row): each for row, each in crops.items()},
    }
    return data, details


def _votes(
    result: Map, evidence: Evidence | None, basis: Floats, origin: Floats
) -> tuple[dict[str, Any], list[str], list[str]]:
    """Return the arrays of the votes, and the names of the images and passes that they are from."""
    labels, votes = result.labels, result.votes
    start = np.searchsorted(votes.label_id, labels.label_id)
    start = np.append(start, len(votes))
    if evidence is None:
        nothing = {name: _packed([], "u4") for name in ("vote_image", "camera_pass", "camera_row")}
        nothing |= {name: _packed([], "f4") for name in ("vote_direction", "camera_at", "vote_px", "vote_sigmas")}
        return {"vote_start": _packed(np.zeros(len(start)), "u4"), **nothing}, [], []
    order = np.lexsort((evidence.drive_order[evidence.image_row], votes.label_id))
    cameras, camera = np.unique(evidence.image_row[order], return_inverse=True)
    direction = np.nan_to_num(evidence.rays.direction_in_world[evidence.detection_row[order]]) @ basis.T
    number = evidence.pass_number[cameras]
    images = evidence.dataset.images
    of_pass: dict[int, str] = {int(n): evidence.pass_name(int(row)) for n, row in zip(number, cameras, strict=True)}
    arrays = {
        "vote_start": _packed(start, "u4"),
        "vote_image": _packed(camera, "u4"),
        "vote_direction": _packed(np.round(direction * 32767.0), "i2"),
        "vote_px": _packed(votes.residual_px[order], "f4"),
        "vote_sigmas": _packed(votes.residual_sigmas[order], "f4"),
        "camera_at": _packed(evidence.center_in_world_m[cameras] @ basis.T - origin, "f4"),
        "camera_pass": _packed(number, "u4"),
        "camera_row": _packed(cameras, "u4"),
    }
    names = [str(name) for name in images.name.take(cameras).to_pylist()] if len(cameras) <= _MOST_NAMED_IMAGES else []
    return arrays, names, [of_pass.get(n, "") for n in range(int(number.max(initial=-1)) + 1)]
