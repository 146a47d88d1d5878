"""XML as several formats need it: characters that XML cannot hold are left out, indented, always the same bytes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def child(parent: ElementTree.Element, tag: str, text: Any = None, **attributes: Any) -> ElementTree.Element:
    """Add an element to another one; attributes that are None are left away."""
    known = {name: clean(value) for name, value in attributes.items() if value is not None}
    element = ElementTree.SubElement(parent, tag, known)
    if text is not None:
        element.text = clean(text)
    return element


def clean(value: Any) -> str:
    """Return a value as text: numbers in full, without the characters that XML 1.0 forbids."""
    return _FORBIDDEN.sub("", repr(value) if isinstance(value, float) else str(value))


def write_xml(root: ElementTree.Element, path: Path) -> None:
    """Write a document."""
    ElementTree.indent(root)
    body = ElementTree.tostring(root, encoding="unicode")
    path.write_text(f'<?xml version="1.0" encoding="UTF-8"?>\n{body}\n', encoding="utf-8")
