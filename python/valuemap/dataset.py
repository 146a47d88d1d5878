"""A dataset: the folder of tables that every reader writes and every stage reads.

This is the door: whatever passes `read_dataset` is consistent, and no stage checks it again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any
from weakref import WeakSet

import numpy as np
import pyarrow as pa

from valuemap.anchor import check_anchor, is_place
from valuemap.arrays import Bools, Floats, Ints
from valuemap.camera_models import camera_models, names_of_params
from valuemap.errors import InputError, check_kind
from valuemap.folders import DATASET_MARKER, MAP_MARKER, new_folder, settle, why_not_there
from valuemap.tables import Cameras, Detections, Images, RejectedRows, Table, Truth, TruthDetections, Votes
from valuemap.tables.check import check_table
from valuemap.tables.read import read_table
from valuemap.tables.write import TableWriter, in_groups, write_table

FORMAT_VERSION = 1
MARKER = DATASET_MARKER
PARTS = (
    MARKER,
    *(f"{name}.parquet" for name in ("cameras", "images", "detections", "truth", "truth_detections", "rejected")),
    "detect.json",
    "boxes.json",
)
"""All files that a dataset may have: none of an older one may stay beside those of a new one."""
PART_FOLDERS = ("images",)
"""Folders of it whose files, as far as valuemap wrote them, are of that dataset alone."""
_QUATERNION_TOLERANCE = 1e-3
_FARTHEST_M = 1e12
"""From the origin of the world: beyond, squares of distances leave what numbers hold."""
LARGEST_PX = 1e9
"""Of a box or a parameter of a camera: no picture has so many."""
ABOVE_ZERO = ("range_m", "range_sigma_m", "vertical_sigma_px")
"""Columns of detections, where they are given, that are above 0."""
_FOCAL_LENGTHS = ("f", "fx", "fy")
LONGEST_READOUT_S = 1.0
"""Of a picture: rolling shutters take hundredths of a second, so that more is milliseconds."""
_ROUNDING = 1e-12
_LEADS_OUT = r"^/|^[A-Za-z]:|^\\\\|(^|[/\\])\.\.([/\\]|$)|\x00"


@dataclass(frozen=True)
class Frame:
    """The world of a dataset: right-handed, metric.

    Either geo-referenced (`anchor` = WGS84 latitude and longitude in degrees and ellipsoidal height in metres
    of the origin; x east, y north, z up) or a frame of its own, of which only `up` (a unit vector) is known.
    """

    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    anchor: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        """Refuse an anchor that is no place on the Earth."""
        if self.anchor is not None:
            check_anchor(self.anchor)

    def __str__(self) -> str:
        """Say it in words, for messages."""
        if self.anchor is not None:
            lat, lon, height_m = self.anchor
            return f"at latitude {lat:.7g}, longitude {lon:.7g}, height {height_m:.4g} m"
        return f"of its own, with {' '.join(f'{part + 0.0:.3g}' for part in self.up)} up"

    @property
    def is_georeferenced(self) -> bool:
        """Whether positions can be given as longitude, latitude and height."""
        return self.anchor is not None

    def east_north(self) -> Floats:
        """Return two unit vectors (2, 3) across up: azimuths count from the second to the first.

        In a frame of its own north is the horizontal part of the axis y, or where y is within 45 degrees of the
        vertical that of z, and east is to the right of it.
        """
        up = np.array(self.up)
        north = np.array([0.0, 1.0, 0.0]) if abs(up[1]) <= math.sqrt(0.5) else np.array([0.0, 0.0, 1.0])
        north -= (north @ up) * up
        north /= np.linalg.norm(north)
        return np.stack([np.cross(north, up), north])

    def east_north_up(self) -> Floats:
        """Return `east_north` and up as rows (3, 3): the rotation from the world into these axes."""
        return np.vstack([self.east_north(), self.up])

    def to_json(self) -> dict[str, Any]:
        """Return the `frame` object of dataset.json and run.json."""
        if self.anchor is not None:
            lat, lon, height = self.anchor
            return {"anchor": {"lat": lat, "lon": lon, "height": height}}
        return {"local": True, "up": list(self.up)}

    @staticmethod
    def from_json(frame: Any, *, source: str) -> Frame:
        """Read the `frame` object; `source` names the file in errors."""
        try:
            if "anchor" in frame:
                lat, lon, height = (float(frame["anchor"][key]) for key in ("lat", "lon", "height"))
                if is_place(lat, lon, height):
                    return Frame(anchor=(lat, lon, height))
            elif frame.get("local"):
                x, y, z = (float(c) for c in frame["up"])
                norm = math.hypot(x, y, z)
                if math.isfinite(norm) and norm > 0.0:
                    return Frame(up=(x / norm, y / norm, z / norm))
        except (TypeError, ValueError, KeyError, AttributeError):
            pass
        raise InputError(
            f'{source}: frame: expected {{"anchor": {{"lat", "lon", "height"}}}} or '
            f'{{"local": true, "up": [x, y, z]}}, found {json.dumps(frame)}',
            hint="lat and lon are WGS84 degrees; up is the direction of the sky",
        )


@dataclass(frozen=True, eq=False, repr=False)
class Dataset:
    """Posed images with detections, the truth where it is known, and what the import had to leave out."""

    name: str
    frame: Frame
    cameras: Cameras
    images: Images
    detections: Detections
    truth: Truth | None = None
    truth_detections: TruthDetections | None = None
    rejected: RejectedRows | None = None

    def __repr__(self) -> str:
        passes = len(np.unique(self.images.pass_id.codes))
        truth = "" if self.truth is None else f", {len(self.truth):,} true objects"
        return (
            f"Dataset({self.name!r}: {len(self.images):,} images of {passes:,} {'pass' if passes == 1 else 'passes'}, "
            f"{len(self.detections):,} detections{truth})"
        )


_CHECKED: WeakSet[Dataset] = WeakSet()
"""Data sets that went through `check_dataset`: they need it no more."""


def ensure_checked(dataset: Dataset) -> Dataset:
    """Return a dataset that is checked: one that was made by hand is checked now, table by table.

    Raises
    ------
    InputError
        As `read_dataset`, by the name of the dataset and of the column.
    """
    if dataset in _CHECKED:
        return dataset
    for f in fields(dataset):
        table = getattr(dataset, f.name)
        if isinstance(table, Table):
            check_table(table, source=f"{dataset.name}: {f.name}")
    return check_dataset(dataset, source=dataset.name)


def checked_as(dataset: Dataset, *parts: Dataset) -> Dataset:
    """Return a dataset whose rows are those of others, which refer to each other as they did there.

    If these are checked it is too, and is not checked again.
    """
    if all(part in _CHECKED for part in parts):
        _CHECKED.add(dataset)
    return dataset


def read_dataset(path: str | Path, *, are_boxes_checked: bool = True) -> Dataset:
    """Read and check a dataset folder; without `are_boxes_checked` boxes may be anywhere, for those who ask why.

    Raises
    ------
    InputError
        A table is missing, damaged or inconsistent; the message names file, row and what to do.
    """
    check_kind("dataset", path, (str, Path), "the folder of a dataset", hint='for example read_dataset("my-data")')
    folder = Path(path)
    name, frame = read_head(folder)
    optional = {
        table: read_table(kind, folder / f"{table}.parquet") if (folder / f"{table}.parquet").is_file() else None
        for table, kind in (("truth", Truth), ("truth_detections", TruthDetections), ("rejected", RejectedRows))
    }
    cameras = read_table(Cameras, folder / "cameras.parquet")
    with ThreadPoolExecutor(1) as beside:
        detections = beside.submit(read_table, Detections, folder / "detections.parquet")
        images = read_table(Images, folder / "images.parquet")
        dataset = Dataset(
            name=name,
            frame=frame,
            cameras=cameras,
            images=images,
            detections=detections.result(),
            **optional,  # type: ignore[arg-type]
        )
    return check_dataset(dataset, source=str(folder), are_boxes_checked=are_boxes_checked)


def expect_dataset(dataset: object) -> None:
    """Refuse what is no `Dataset`, where a function takes nothing else; raises `InputError`."""
    check_kind("dataset", dataset, Dataset, "a Dataset", hint="read_dataset reads one from its folder")


def read_images(path: str | Path) -> tuple[Cameras, Images]:
    """Read and check the cameras and images of a dataset folder, whose detections are still to be made.

    Raises
    ------
    InputError
        As `read_dataset`.
    """
    folder = Path(path)
    read_head(folder)
    cameras, images = read_table(Cameras, folder / "cameras.parquet"), read_table(Images, folder / "images.parquet")
    check_cameras(cameras, str(folder))
    return cameras, check_images(images, cameras, str(folder))


def write_dataset(dataset: Dataset, path: str | Path, *, force: bool = False) -> None:
    """Check a dataset and write it as a folder; an older dataset that is there is replaced, never half.

    Other files in the folder stay. Where one that valuemap did not write is in the way, an `OutputError` says so; with
    `force` it is replaced.
    """
    expect_dataset(dataset)
    write_dataset_in_pieces([check_dataset(dataset, source=dataset.name)], path, force=force)


def write_dataset_in_pieces(pieces: Iterable[Dataset], path: str | Path, *, force: bool = False) -> None:
    """Write pieces of a dataset, at least one, one after the other as `write_dataset`: only one is held at a time.

    Name, frame and cameras are those of the first piece, which the others must have too. Ids of all tables ascend from
    piece to piece, and what a piece refers to is in it. All pieces have the same tables and columns.
    """
    with new_folder(Path(path), parts=PARTS, part_folders=PART_FOLDERS, force=force) as folder, ExitStack() as opened:
        writers: dict[str, TableWriter] = {}
        for number, piece in enumerate(pieces):
            piece = ensure_checked(piece)
            if number == 0:
                _write_head(piece, folder)
            for name, table in _tables_of(piece).items():
                if number == 0:
                    writers[name] = opened.enter_context(TableWriter(folder / f"{name}.parquet"))
                writers[name].write(table)


def write_dataset_in_portions(
    dataset: Dataset,
    detections: Iterable[Detections],
    rejected: Iterable[RejectedRows],
    path: str | Path,
    *,
    force: bool = False,
) -> None:
    """Write a dataset as `write_dataset`, its detections and what was left out in portions: to the same bytes.

    Detections come by ascending ids. What `dataset` has of the two does not count.
    """
    dataset = check_dataset(dataset, source=dataset.name)
    images = dataset.images

    def checked() -> Iterator[Detections]:
        for portion in detections:
            check_detections(portion, images.image_id, images.camera_id, dataset.cameras, dataset.name)
            yield portion

    tables: dict[str, Iterable[Table]] = {name: [table] for name, table in _tables_of(dataset).items()}
    tables |= {"detections": checked(), "rejected": rejected}
    with new_folder(Path(path), parts=PARTS, part_folders=PART_FOLDERS, force=force) as folder:
        _write_head(dataset, folder)
        for name, portions in tables.items():
            with ExitStack() as opened:
                writer = None
                for group in in_groups(portions):
                    writer = writer or opened.enter_context(TableWriter(folder / f"{name}.parquet"))
                    writer.write(group)


def _write_head(dataset: Dataset, folder: Path) -> None:
    head = {"format_version": FORMAT_VERSION, "name": dataset.name, "frame": dataset.frame.to_json()}
    (folder / MARKER).write_text(json.dumps(head, indent=2) + "\n", encoding="utf-8")
    write_table(dataset.cameras, folder / "cameras.parquet")


def _tables_of(dataset: Dataset) -> dict[str, Table]:
    """Return the tables of a dataset, but for its cameras, by their names on disk."""
    names = ("images", "detections", "truth", "truth_detections", "rejected")
    return {name: table for name in names if (table := getattr(dataset, name)) is not None}


def check_dataset(dataset: Dataset, *, source: str, are_boxes_checked: bool = True) -> Dataset:
    """Check what only holds between tables, and return the dataset with quaternions normalised.

    Without `are_boxes_checked` nothing is asked of boxes but an image that is known.

    Raises
    ------
    InputError
        An unknown camera model or id, a quaternion that is not of unit length, a detection of an unknown
        image, outside its picture by more than a box, or with a size that cannot be.
    """
    check_cameras(dataset.cameras, source)
    images = check_images(dataset.images, dataset.cameras, source)
    check_detections(
        dataset.detections,
        images.image_id,
        images.camera_id,
        dataset.cameras,
        source,
        are_boxes_checked=are_boxes_checked,
    )
    if dataset.truth_detections is not None:
        pairs = dataset.truth_detections
        if dataset.truth is None:
            raise InputError(
                f"{source}: truth_detections.parquet without truth.parquet",
                hint="add truth.parquet, or remove truth_detections.parquet",
            )
        _check_known(
            pairs.object_id,
            dataset.truth.object_id,
            pairs.detection_id,
            source,
            "truth_detections",
            "object_id",
            "truth",
        )
        _check_known(
            pairs.detection_id,
            dataset.detections.detection_id,
            pairs.detection_id,
            source,
            "truth_detections",
            "detection_id",
            "detections",
        )
    checked = Dataset(**{**vars(dataset), "images": images})
    _CHECKED.add(checked)
    return checked


def rows_of(ids: Ints, keys: Ints) -> Ints:
    """Return the row in sorted unique `keys` of each of `ids`, all of which must be there."""
    if len(keys) and keys[-1] - keys[0] == len(keys) - 1:  # Without gaps, as most ids are: nothing is to be looked for.
        return np.asarray(ids - keys[0], np.int64)
    return np.searchsorted(keys, ids).astype(np.int64)


def rows_of_votes(votes: Votes, dataset: Dataset) -> tuple[Ints, Ints]:
    """Return the rows of votes in the tables of detections and images of the dataset that the map was made from.

    Raises
    ------
    InputError
        A vote is by a detection or an image that the dataset does not have, or has elsewhere.
    """
    hint = "give the dataset that the map was made from (--dataset)"
    for column, ids, known in (
        ("detection_id", votes.detection_id, dataset.detections.detection_id),
        ("image_id", votes.image_id, dataset.images.image_id),
    ):
        strange = np.flatnonzero(~np.isin(ids, known))
        if len(strange):
            raise InputError(
                f"votes.parquet row {strange[0]}: {column} {ids[strange[0]]} is not in the dataset {dataset.name} "
                f"({len(strange)} rows)",
                hint=hint,
            )
    detection_row: Ints = rows_of(votes.detection_id, dataset.detections.detection_id)
    moved = np.flatnonzero(dataset.detections.image_id[detection_row] != votes.image_id)
    if len(moved):  # Ids are small numbers, which other datasets have too.
        raise InputError(
            f"votes.parquet row {moved[0]}: detection_id {votes.detection_id[moved[0]]} is of another image in the "
            f"dataset {dataset.name} ({len(moved)} rows)",
            hint=hint,
        )
    return detection_row, rows_of(votes.image_id, dataset.images.image_id)


def evenly(rows: Ints, most: int) -> Ints:
    """Return at most so many of some rows (N), spread evenly over all of them."""
    if len(rows) <= most:
        return rows
    return np.asarray(rows[np.linspace(0, len(rows) - 1, most).round().astype(np.int64)])


def number_passes(images: Images) -> Ints:
    """Return the number (N) of each image's pass, in the order of their first images: the names do not matter."""
    _, first, inverse = np.unique(images.pass_id.codes, return_index=True, return_inverse=True)
    number = np.empty(len(first), dtype=np.int64)
    number[np.argsort(first)] = np.arange(len(first))
    return number[inverse]


def read_head(folder: Path) -> tuple[str, Frame]:
    """Return the name and the frame of a dataset; raises `InputError` where the folder is none."""
    path = folder / MARKER
    settle(folder)
    if not path.is_file():
        if (folder / MAP_MARKER).is_file():
            raise InputError(f"{folder}: is a map, not a dataset", hint="give the dataset that it was made from")
        raise InputError(
            f"{folder}: is not a dataset: {why_not_there(folder, MARKER)}",
            hint="make one with valuemap import or valuemap simulate",
        )
    try:
        head = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as JSON: {error}", hint="repair it or import again") from error
    if not isinstance(head, dict) or head.get("format_version") != FORMAT_VERSION:
        found = head.get("format_version") if isinstance(head, dict) else head
        raise InputError(
            f"{path}: format_version: expected {FORMAT_VERSION}, found {found}",
            hint="import the data again with this version of valuemap",
        )
    return str(head.get("name", folder.name)), Frame.from_json(head.get("frame"), source=str(path))


def check_cameras(cameras: Cameras, source: str) -> None:
    """Refuse cameras that cannot be; raises as `read_dataset`."""
    for row in range(len(cameras)):
        where = f"{source}/cameras.parquet, row with camera_id {cameras.camera_id[row]}"
        model = cameras.model.names[cameras.model.codes[row]]
        expected = names_of_params(model)
        if expected is None:
            known = ", ".join(camera_models())
            raise InputError(f"{where}: model: found {model!r}", hint=f"use one of COLMAP's camera models: {known}")
        width, height, params = int(cameras.width_px[row]), int(cameras.height_px[row]), cameras.params[row]
        if width <= 0 or height <= 0:
            raise InputError(
                f"{where}: width and height: expected pixels above 0, found {width} x {height}",
                hint="give the size of the pictures that the detections were made on",
            )
        names = [name.strip() for name in expected.split(",")]
        if len(params) != len(names) or not np.all(np.abs(params) <= LARGEST_PX):
            raise InputError(
                f"{where}: params: {model} expects {len(names)} finite numbers ({expected}), found {params.tolist()}",
                hint=f"give the parameters in COLMAP's order, in pixels, none above {LARGEST_PX:g}",
            )
        if not all(value > 0.0 for name, value in zip(names, params, strict=True) if name in _FOCAL_LENGTHS):
            raise InputError(
                f"{where}: params: expected focal lengths above 0, found {params.tolist()} ({expected})",
                hint="give the parameters in COLMAP's order, in pixels",
            )
    if cameras.readout_s is not None:
        _refuse(
            np.abs(cameras.readout_s) > LONGEST_READOUT_S,
            cameras.readout_s,
            cameras.camera_id,
            source,
            "cameras",
            "camera_id",
            "readout_s",
            f"expected at most {LONGEST_READOUT_S:g} s, or no value",
            hint="it is in seconds, from the first row of a picture to the last; 30 ms are 0.03",
        )


def check_images(images: Images, cameras: Cameras, source: str) -> Images:
    """Return images with quaternions normalised; raises as `read_dataset`."""
    _check_known(images.camera_id, cameras.camera_id, images.image_id, source, "images", "camera_id", "cameras")
    _check_names(images, source)
    w, x, y, z = images.cam_from_world_quat.T
    with np.errstate(over="ignore"):
        norm = np.sqrt(w * w + x * x + y * y + z * z)  # In a third of the time of NumPy's norm, to the same bits.
    wrong = np.flatnonzero(np.abs(norm - 1.0) > _QUATERNION_TOLERANCE)
    if len(wrong):
        row = wrong[0]
        raise InputError(
            f"{source}/images.parquet, row with image_id {images.image_id[row]}: qw qx qy qz: expected a quaternion of "
            f"length 1, found length {norm[row]:.6g} ({len(wrong)} rows)",
            hint="quaternions are w, x, y, z and rotate the world into the camera",
        )
    for axis, name in enumerate(("tx", "ty", "tz")):
        value = images.cam_from_world_m[:, axis]
        where = (source, "images", "image_id", name)
        _refuse(np.abs(value) > _FARTHEST_M, value, images.image_id, *where, f"expected at most {_FARTHEST_M:g} m")
    for name in ("position_sigma_m", "rotation_sigma_rad"):
        _check_positive(getattr(images, name), images.image_id, source, "images", "image_id", name)
    # Those of unit length to rounding stay as they are, so that writing and reading again changes no bit.
    is_off = np.abs(norm - 1.0) > _ROUNDING
    if not is_off.any():
        return images
    scale = np.where(is_off, norm, 1.0)
    return images.replace(cam_from_world_quat=images.cam_from_world_quat / scale[:, None])


def _check_names(images: Images, source: str) -> None:
    """Refuse names that lead out of the folder of the pictures: they are opened by them."""
    if pa.types.is_string(images.name.type) and not _may_lead_out(images.name):
        return
    import pyarrow.compute as pc  # Slow to import, and few names look like that.

    found = pc.match_substring_regex(images.name, _LEADS_OUT)
    if pc.any(found).as_py():
        leads_out = found.to_pylist()
        row = leads_out.index(True)
        raise InputError(
            f"{source}/images.parquet, row with image_id {images.image_id[row]}: name: expected a path in the folder "
            f"of the pictures, found {images.name[row].as_py()!r} ({leads_out.count(True)} rows)",
            hint="name pictures relative to one folder, without ..",
        )


def _may_lead_out(names: pa.StringArray) -> bool:
    """Return whether there is in names what all that lead out have: a quarter of the time of looking at each."""
    _, offsets, letters = names.buffers()
    text = np.frombuffer(letters or b"", np.uint8)
    first = np.frombuffer(offsets or b"", np.int32)[names.offset : names.offset + len(names)]
    if np.any(text[first[first < len(text)]] == ord("/")):  # Of an empty name it is that of the next one.
        return True
    is_dot = text == ord(".")
    return bool(np.any(is_dot[1:] & is_dot[:-1]) or any(np.any(text == sign) for sign in b"\\:\0"))


def check_detections(
    detections: Detections,
    image_id: Ints,
    camera_id: Ints,
    cameras: Cameras,
    source: str,
    *,
    are_boxes_checked: bool = True,
) -> None:
    """Refuse detections that images (N, by id) with these cameras cannot have; raises as `read_dataset`."""
    ids = detections.detection_id
    _check_known(detections.image_id, image_id, ids, source, "detections", "image_id", "images")
    if not are_boxes_checked:
        return
    where = (source, "detections", "detection_id")
    center_px, size_px = detections.center_px, detections.size_px
    # Both columns at once: one of them alone takes as long.
    is_negative, is_too_large = size_px < 0.0, size_px > LARGEST_PX
    for i, name in enumerate(("width", "height")):
        _refuse(is_negative[:, i], size_px[:, i], ids, *where, name, "expected at least 0 px")
        _refuse(is_too_large[:, i], size_px[:, i], ids, *where, name, f"expected at most {LARGEST_PX:g} px")
    for name in ABOVE_ZERO:
        _check_positive(getattr(detections, name), ids, *where, name)
    extent_px = np.column_stack([cameras.width_px, cameras.height_px])
    if np.all(extent_px == extent_px[:1]):
        extent_px = extent_px[:1]  # Nobody has to ask which camera it was.
    else:
        extent_px = extent_px[rows_of(camera_id, cameras.camera_id)[rows_of(detections.image_id, image_id)]]
    is_outside = outside_by_a_box(center_px, size_px, extent_px)
    for i, axis in enumerate(("x", "y")):
        _refuse(
            is_outside[:, i],
            center_px[:, i],
            ids,
            *where,
            axis,
            "expected a centre inside its picture or within a box of it",
            hint="are the boxes in pixels of the size in cameras.parquet, and x, y their centres?",
        )


def outside_by_a_box(center_px: Floats, size_px: Floats, extent_px: Floats | Ints) -> Bools:
    """Return which centres (N, 2) are outside of pictures of some extent by more than a box, by axis."""
    return np.asarray((center_px < -size_px) | (center_px > extent_px + size_px))


def _check_known(ids: Ints, known: Ints, keys: Ints, source: str, table: str, column: str, other: str) -> None:
    if len(known) and known[-1] - known[0] == len(known) - 1:  # Without gaps, as most ids are.
        unknown = (ids < known[0]) | (ids > known[-1])
    else:
        unknown = ~np.isin(ids, known)
    key = "detection_id" if table != "images" else "image_id"
    expected = f"expected an id that is in {other}.parquet"
    hint = f"add it to {other}.parquet, or remove these rows from {table}.parquet"
    _refuse(unknown, ids, keys, source, table, key, column, expected, hint=hint)


def _check_positive(values: Floats | None, keys: Ints, source: str, table: str, key: str, column: str) -> None:
    if values is not None:
        _refuse(values <= 0.0, values, keys, source, table, key, column, "expected above 0, or no value")


def _refuse(
    wrong: Bools,
    values: Floats | Ints,
    keys: Ints,
    source: str,
    table: str,
    key: str,
    column: str,
    expected: str,
    *,
    hint: str = "repair or remove these rows",
) -> None:
    """Raise one error for all wrong rows, showing the first."""
    rows = np.flatnonzero(wrong)
    if len(rows):
        raise InputError(
            f"{source}/{table}.parquet, row with {key} {keys[rows[0]]}: {column}: {expected}, "
            f"found {values[rows[0]]} ({len(rows)} rows)",
            hint=hint,
        )
