"""Arrays for the browser: named columns in one body that it views as typed arrays, without a copy or a parser.

The body is the length of the header (4 bytes, little-endian), the header (JSON: name, type, rows, width and offset of
each column), then the columns, each at a multiple of 8 bytes from the start.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TYPES = {"f4": "Float32Array", "f8": "Float64Array", "i4": "Int32Array", "u1": "Uint8Array"}
_ALIGNMENT = 8


def pack_columns(columns: Mapping[str, NDArray[Any]]) -> bytes:
    """Return arrays (N) or (N, K) of float32, float64, int32 or uint8 as one body."""
    arrays = {name: np.ascontiguousarray(each, each.dtype.newbyteorder("<")) for name, each in columns.items()}
    described = [
        {
            "name": name,
            "type": _TYPES[each.dtype.str[1:]],
            "rows": len(each),
            "width": 1 if each.ndim == 1 else each.shape[1],
            "offset": 0,
        }
        for name, each in arrays.items()
    ]
    # Offsets change the length of the header, so they are written with a fixed number of digits.
    sizes = [each.nbytes for each in arrays.values()]
    blank = _header([{**each, "offset": 10**12} for each in described])
    start = _aligned(4 + len(blank))
    offset = start
    for each, size in zip(described, sizes, strict=True):
        each["offset"] = offset
        offset = _aligned(offset + size)
    header = _header(described).ljust(len(blank))
    body = bytearray(offset)
    body[:4] = len(header).to_bytes(4, "little")
    body[4 : 4 + len(header)] = header
    for each, array in zip(described, arrays.values(), strict=True):
        body[each["offset"] : each["offset"] + array.nbytes] = array.tobytes()
    return bytes(body)


def _header(described: list[dict[str, Any]]) -> bytes:
    return json.dumps(described, separators=(",", ":")).encode()


def _aligned(offset: int) -> int:
    return -(-offset // _ALIGNMENT) * _ALIGNMENT
