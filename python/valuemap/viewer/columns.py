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
    # Offsets are within the header that comes before the columns: room is made that surely holds it.
    room = _aligned(4 + len(_header(arrays, [10**12] * len(arrays))))
    offsets = []
    end = room
    for each in arrays.values():
        offsets.append(end)
        end = _aligned(end + each.nbytes)
    header = _header(arrays, offsets).ljust(room - 4)
    body = bytearray(end)
    body[:room] = len(header).to_bytes(4, "little") + header
    for offset, each in zip(offsets, arrays.values(), strict=True):
        body[offset : offset + each.nbytes] = each.tobytes()
    return bytes(body)


def _header(arrays: Mapping[str, NDArray[Any]], offsets: list[int]) -> bytes:
    described = [
        {
            "name": name,
            "type": _TYPES[each.dtype.str[1:]],
            "rows": len(each),
            "width": 1 if each.ndim == 1 else each.shape[1],
            "offset": offset,
        }
        for (name, each), offset in zip(arrays.items(), offsets, strict=True)
    ]
    return json.dumps(described, separators=(",", ":")).encode()


def _aligned(offset: int) -> int:
    return -(-offset // _ALIGNMENT) * _ALIGNMENT
