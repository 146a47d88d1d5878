"""How QGIS draws the layers of a GeoPackage: kept in it as `layer_styles`, which QGIS reads by itself."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from xml.etree import ElementTree

from valuemap.writers.xml import child

_HEAD = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
_VERSION = "3.28.0-Firenze"


def labels_style(classes: Sequence[str]) -> str:
    """Return a style of points, a colour for each class, larger the more images vote for them."""
    root, renderer = _style("categorizedSymbol", attr="class")
    categories, symbols = child(renderer, "categories"), child(renderer, "symbols")
    for number, name in enumerate(classes):
        child(categories, "category", value=name, label=name, symbol=number, render="true", type="string")
        symbol = child(symbols, "symbol", type="marker", name=number, alpha=1, clip_to_extent=1, force_rhr=0)
        color = _color(number, len(classes), alpha=255)
        layer = _layer(
            symbol, "SimpleMarker", name="circle", color=color, outline_color="35,35,35,255", size="2.4", size_unit="MM"
        )
        _bind(layer, size='2 + ln("votes")')
    return _text(root)


def ellipses_style() -> str:
    """Return a style of areas: seen through, with a line around."""
    root, renderer = _style("singleSymbol")
    symbol = child(child(renderer, "symbols"), "symbol", type="fill", name=0, alpha=1, clip_to_extent=1, force_rhr=0)
    _layer(
        symbol, "SimpleFill", color="255,170,0,60", outline_color="200,110,0,255", outline_width="0.26", style="solid"
    )
    return _text(root)


def votes_style() -> str:
    """Return a style of thin lines."""
    root, renderer = _style("singleSymbol")
    symbol = child(child(renderer, "symbols"), "symbol", type="line", name=0, alpha=0.5, clip_to_extent=1, force_rhr=0)
    _layer(symbol, "SimpleLine", line_color="120,120,120,160", line_width="0.1", line_width_unit="MM")
    return _text(root)


def cameras_style() -> str:
    """Return a style of arrows that point where the cameras look."""
    root, renderer = _style("singleSymbol")
    symbol = child(child(renderer, "symbols"), "symbol", type="marker", name=0, alpha=1, clip_to_extent=1, force_rhr=0)
    layer = _layer(symbol, "SimpleMarker", name="filled_arrowhead", color="60,110,190,180", size="1.6", size_unit="MM")
    # The arrowhead points to the right where it is not turned.
    _bind(layer, angle='"heading_deg" - 90')
    return _text(root)


def _style(kind: str, **attributes: str) -> tuple[ElementTree.Element, ElementTree.Element]:
    root = ElementTree.Element("qgis", version=_VERSION, styleCategories="Symbology")
    return root, child(
        root, "renderer-v2", type=kind, enableorderby=0, forceraster=0, symbollevels=0, referencescale=-1, **attributes
    )


def _layer(symbol: ElementTree.Element, kind: str, **options: str) -> ElementTree.Element:
    layer = child(symbol, "layer", **{"class": kind}, enabled=1, locked=0)
    layer.set("pass", "0")
    box = child(layer, "Option", type="Map")
    for name, value in options.items():
        child(box, "Option", name=name, type="QString", value=value)
    return layer


def _bind(layer: ElementTree.Element, **expressions: str) -> None:
    """Let properties of a symbol follow expressions over the attributes."""
    box = child(child(layer, "data_defined_properties"), "Option", type="Map")
    child(box, "Option", name="name", type="QString", value="")
    properties = child(box, "Option", name="properties", type="Map")
    for name, expression in expressions.items():
        entry = child(properties, "Option", name=name, type="Map")
        child(entry, "Option", name="active", type="bool", value="true")
        child(entry, "Option", name="expression", type="QString", value=expression)
        child(entry, "Option", name="type", type="int", value=3)
    child(box, "Option", name="type", type="QString", value="collection")


def _color(number: int, count: int, *, alpha: int) -> str:
    parts = colorsys.hls_to_rgb(number / max(count, 1), 0.45, 0.75)
    return ",".join(str(round(255 * part)) for part in parts) + f",{alpha}"


def _text(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return _HEAD + ElementTree.tostring(root, encoding="unicode")
