"""The outline of a detection in Mapillary's API: a Mapbox vector tile with one layer, as base64."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterator

import numpy as np

from valuemap.arrays import Floats

_LAYER, _FEATURE, _GEOMETRY, _EXTENT = 3, 2, 4, 5
_DEFAULT_EXTENT = 4096
_MOVE, _LINE, _CLOSE = 1, 2, 7
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def outline_of_tile(text: str) -> Floats:
    """Return the points (N, 2) of all geometries as fractions of the picture's width and height, from its top left.

    Decoded by the specification of Mapbox vector tiles 2.1: commands with deltas in zigzag encoding, y down.

    Raises
    ------
    ValueError
        The text is no base64, or the bytes are no such tile.
    """
    try:
        data = base64.b64decode("".join(text.split()), validate=True)
    except (binascii.Error, ValueError) as error:
        raise ValueError("is no base64") from error
    points: list[Floats] = []
    for field, layer in _fields(data):
        if field == _LAYER and isinstance(layer, bytes):
            extent, geometries = _DEFAULT_EXTENT, []
            for inner, value in _fields(layer):
                if inner == _EXTENT and isinstance(value, int):
                    extent = value
                elif inner == _FEATURE and isinstance(value, bytes):
                    geometries += [part for key, part in _fields(value) if key == _GEOMETRY and isinstance(part, bytes)]
            if not extent:
                raise ValueError("has an extent of 0")
            points += [_points(geometry) / extent for geometry in geometries]
    if not points or not sum(map(len, points)):
        raise ValueError("has no points")
    return np.concatenate(points)


def _points(geometry: bytes) -> Floats:
    """Return the corners (N, 2) that the commands of a geometry visit."""
    values = list(_varints(geometry))
    found, x, y, at = [], 0, 0, 0
    while at < len(values):
        command, count = values[at] & 7, values[at] >> 3
        at += 1
        if command == _CLOSE:
            continue
        if command not in (_MOVE, _LINE) or at + 2 * count > len(values):
            raise ValueError("has a command that is not known")
        for _ in range(count):
            x, y = x + _unzigzag(values[at]), y + _unzigzag(values[at + 1])
            found.append((x, y))
            at += 2
    return np.array(found, dtype=np.float64).reshape(-1, 2)


def _unzigzag(value: int) -> int:
    return (value >> 1) ^ -(value & 1)


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Yield number and value of the fields of a protocol buffer."""
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        kind = tag & 7
        if kind == _VARINT:
            value, at = _varint(data, at)
            yield tag >> 3, value
            continue
        if kind == _BYTES:
            length, at = _varint(data, at)
        elif kind in (_FIXED32, _FIXED64):
            length = 4 if kind == _FIXED32 else 8
        else:
            raise ValueError("is no vector tile")
        if at + length > len(data):
            raise ValueError("is cut short")
        yield tag >> 3, data[at : at + length]
        at += length


def _varints(data: bytes) -> Iterator[int]:
    at = 0
    while at < len(data):
        value, at = _varint(data, at)
        yield value


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if at >= len(data) or shift > 63:
            raise ValueError("is cut short")
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at
