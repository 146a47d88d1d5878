"""Finding the files of a COLMAP model, and refusing what pycolmap would read in part without a word.

pycolmap reads past the end of a cut binary file (whatever was in memory, or for ever), stops at the last
whole image of a cut images.txt, and takes an image for the points of the one before where a second line is
missing.
"""

from __future__ import annotations

import codecs
import math
import mmap
import re
import struct
from collections.abc import Callable
from pathlib import Path

from valuemap.colmap import pycolmap
from valuemap.errors import InputError

_NEEDED = ("cameras", "images")
_OPTIONAL = ("rigs", "frames")
_POSE_BYTES = 7 * 8


def find_model(model_dir: Path) -> list[Path]:
    """Return the files of a model to read: cameras, images, and rigs and frames where both exist.

    Binary files are preferred to text where both are whole sets, as in COLMAP. Points are not needed.

    Raises
    ------
    InputError
        There is no model, or one of its files is cut short or lacks lines.
    """
    if not model_dir.is_dir():
        raise InputError(f"{model_dir}: no such folder", hint="give the folder with cameras.bin and images.bin or .txt")
    for suffix, check in ((".bin", _check_binary), (".txt", _check_text)):
        needed = [model_dir / f"{name}{suffix}" for name in _NEEDED]
        if all(path.is_file() for path in needed):
            rig_files = [model_dir / f"{name}{suffix}" for name in _OPTIONAL]
            files = needed + (rig_files if all(path.is_file() for path in rig_files) else [])
            for path in files:
                check(path)
            return files
    found = sorted(path.name for path in model_dir.iterdir() if path.stem in _NEEDED + _OPTIONAL)
    raise InputError(
        f"{model_dir}: not a COLMAP model: expected cameras.bin and images.bin, or both as .txt, "
        f"found {' and '.join(found) or 'none of them'}",
        hint="give the folder that COLMAP wrote the model to, often sparse/0",
    )


def has_mark(path: Path) -> bool:
    """Return whether a text file begins with a byte order mark, as Windows' editors write it."""
    with path.open("rb") as file:
        return file.read(len(codecs.BOM_UTF8)) == codecs.BOM_UTF8


def copy_without_points(path: Path, to: Path) -> None:
    """Copy a whole images.bin without the observations of points: they are most of it, and not needed."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data, to.open("wb") as copy:
        (images,) = struct.unpack_from("<Q", data)
        copy.write(data[:8])
        start = 8
        for _ in range(images):
            name_end = _name_end(data, start)
            copy.write(data[start : name_end + 1])
            copy.write(bytes(8))
            start = _image_end(data, start)


def _check_binary(path: Path) -> None:
    record_end = _RECORD_ENDS[path.stem]
    size = path.stat().st_size
    end, records = -1, 0
    if size >= 8:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            (records,) = struct.unpack_from("<Q", data)
            end = 8
            try:
                for _ in range(records):
                    end = record_end(data, end)
            except (struct.error, ValueError, OverflowError):  # Past the end, or not a camera model.
                end = -1
    if end != size:
        raise InputError(
            f"{path}: damaged or cut short: it announces {records} {path.stem}, which do not make its {size} bytes",
            hint="copy or export the model again",
        )


def _camera_end(data: mmap.mmap, start: int) -> int:
    (model,) = struct.unpack_from("<i", data, start + 4)
    return start + 24 + 8 * len(_params_of(pycolmap.CameraModelId(model)))


def _params_of(model: pycolmap.CameraModelId) -> list[str]:
    """Return the names of the parameters of a camera model."""
    names = pycolmap.Camera(model=model, width=1, height=1).params_info
    return [name.strip() for name in names.split(",")]


def _name_end(data: mmap.mmap, start: int) -> int:
    end = data.find(b"\0", start + 8 + _POSE_BYTES)
    if end < 0:
        raise ValueError
    return end


def _image_end(data: mmap.mmap, start: int) -> int:
    name_end = _name_end(data, start)
    (points,) = struct.unpack_from("<Q", data, name_end + 1)
    return int(name_end + 9 + 24 * points)


def _rig_end(data: mmap.mmap, start: int) -> int:
    (sensors,) = struct.unpack_from("<I", data, start + 4)
    end = start + 8 + (8 if sensors else 0)
    for _ in range(sensors - 1):
        (has_pose,) = struct.unpack_from("<B", data, end + 8)
        end += 9 + (_POSE_BYTES if has_pose else 0)
    return end


def _frame_end(data: mmap.mmap, start: int) -> int:
    (images,) = struct.unpack_from("<I", data, start + 8 + _POSE_BYTES)
    return int(start + 12 + _POSE_BYTES + 16 * images)


_RECORD_ENDS: dict[str, Callable[[mmap.mmap, int], int]] = {
    "cameras": _camera_end,
    "images": _image_end,
    "rigs": _rig_end,
    "frames": _frame_end,
}


def _check_text(path: Path) -> None:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text: {error}", hint="export the model again") from error
    records = {"cameras": _check_cameras, "images": _check_images}.get(path.stem, _count)(path, lines)
    announced = re.search(r"^# Number of \w+: (\d+)", "\n".join(lines[:10]), re.MULTILINE)
    if announced and records < int(announced[1]):
        raise InputError(
            f"{path}: cut short: it announces {announced[1]} {path.stem} and holds {records}",
            hint="copy or export the model again, or correct the comment in its first lines",
        )


def _is_data(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _count(_path: Path, lines: list[str]) -> int:
    return sum(map(_is_data, lines))


def _check_cameras(path: Path, lines: list[str]) -> int:
    """Return the number of cameras; refuse a row that is none, which pycolmap does without saying where."""
    known: set[int] = set()
    for number, line in enumerate(lines, start=1):
        if not _is_data(line):
            continue
        where, fields = f"{path} line {number}", line.split()
        model = pycolmap.CameraModelId.__members__.get(fields[1] if len(fields) > 1 else "")
        if model is None or fields[1] == "INVALID":
            raise InputError(
                f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, found {_short(line)}",
                hint="models are those of COLMAP in capitals, as PINHOLE or OPENCV",
            )
        names = _params_of(model)
        if len(fields) != 4 + len(names) or not _are_numbers(fields[4:]):
            raise InputError(
                f"{where}: {fields[1]} expects {len(names)} finite numbers ({', '.join(names)}) after the size, "
                f"found {' '.join(fields[4:])!r}",
                hint="every camera takes one line: CAMERA_ID MODEL WIDTH HEIGHT PARAMS",
            )
        _refuse_no_ids({"WIDTH": fields[2], "HEIGHT": fields[3]}, where)
        _add_id("CAMERA_ID", fields[0], known, where)
    return len(known)


def _check_images(path: Path, lines: list[str]) -> int:
    """Return the number of images: each has a line for its pose and one, maybe empty, for its points."""
    cameras = path.with_name("cameras.txt").read_text(encoding="utf-8-sig").splitlines()
    camera_ids = {int(line.split()[0]) for line in cameras if _is_data(line)}
    known: set[int] = set()
    row = 0
    while row < len(lines):
        if not _is_data(lines[row]):
            row += 1
            continue
        where, fields = f"{path} line {row + 1}", lines[row].split()
        if len(fields) != 10 or not _are_numbers(fields[1:8]):
            raise InputError(
                f"{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, found {_short(lines[row])} "
                f"({len(fields)} fields)",
                hint="all but the name are finite numbers; names with spaces are whole only in a model binary from its "
                "start: write other letters for the spaces, here and in the detections",
            )
        _add_id("IMAGE_ID", fields[0], known, where)
        _refuse_no_ids({"CAMERA_ID": fields[8]}, where)
        if int(fields[8]) not in camera_ids:
            raise InputError(
                f"{where}: camera {fields[8]} of image {fields[9]!r} is not in cameras.txt",
                hint="export the model again, or add the camera",
            )
        if row + 1 == len(lines) or len(lines[row + 1].split()) % 3:
            raise InputError(
                f"{path} line {row + 2}: expected an empty line, or the points of image {fields[9]!r} "
                "(X Y POINT3D_ID ...)",
                hint="every image takes two lines; the second may be empty, but it must be there",
            )
        row += 2
    return len(known)


_LARGEST_ID = 2**32 - 2


def _add_id(name: str, text: str, known: set[int], where: str) -> None:
    _refuse_no_ids({name: text}, where)
    if int(text) in known:
        raise InputError(f"{where}: {name} {text} is there twice", hint="give every row an id of its own")
    known.add(int(text))


def _refuse_no_ids(text_of: dict[str, str], where: str) -> None:
    for name, text in text_of.items():
        if not (text.isascii() and text.isdigit() and len(text) <= _DIGITS and int(text) <= _LARGEST_ID):
            raise InputError(
                f"{where}: {name}: expected a whole number from 0 to {_LARGEST_ID}, found {text[:40]!r}",
                hint="COLMAP's ids and sizes have 32 bits",
            )


_DIGITS = 20


def _are_numbers(texts: list[str]) -> bool:
    try:
        return all(math.isfinite(float(text)) for text in texts)
    except ValueError:
        return False


def _short(line: str) -> str:
    return repr(line.strip()[:60])
