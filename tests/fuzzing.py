"""Structured fuzzing: whole input is made, spoiled where its structure is, and read; what may come out is checked.

A target takes a `random.Random`. In tests that is hypothesis' own, so that what fails is made small; in
`benchmarks/fuzz.py` it is a seeded one, so that a million cases take minutes. A case must end in a result or in a
`ValuemapError` of one line: any other exception, a panic of the core among them, is a fault.
"""

from __future__ import annotations

import copy
import json
import struct
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import test_readers_detections as boxes_of
import test_readers_formats as poses_of
from small_dataset import small_dataset
from test_readers import model_of, write_kitti, write_model
from valuemap import _core
from valuemap.config import MapConfig, describe_settings
from valuemap.dataset import Dataset, Frame, check_dataset, read_dataset, write_dataset
from valuemap.errors import ValuemapError
from valuemap.map_folder import Map
from valuemap.pipeline import build_map
from valuemap.readers.bearings import read_bearings
from valuemap.readers.colmap import read_colmap
from valuemap.readers.csv_poses import read_csv_poses
from valuemap.readers.detections import DETECTIONS
from valuemap.readers.kitti import read_kitti
from valuemap.robust import Noise
from valuemap.tables import Categories

NUMBERS: tuple[float, ...] = (
    0, -0.0, 1, -1, 2, 0.5, 1e-320, 1e-12, 1e-3, 7.0, 90.0, 180.0, 360.0, 1e4, 1e9, 1e18, 1e200, 1e308, -1e308,
    float("nan"), float("inf"), float("-inf"), 255, 65536, 2**31, 2**32, 2**53 + 1, 2**63 - 1, 2**63, -(2**63), 2**70,
)  # fmt: skip
TEXTS = (
    "", " ", "a.jpg", "../a.jpg", "/etc/passwd", "a/../../b", "[/]", "[bold]", "\0", "\x1b[31m", "é", "\u2028",
    "a" * 3000,
    "=1+1", "nan", "inf", "-inf", "1e999", "0x10", "1_000", "\u0661", "1,5", "true", "null", ",", ";", "\t", "\n", '"',
    "'", "#", "1 2 3", "\ufeff", "PINHOLE", "C:\\a", "*a", "&a x", "!!python/object:os.system x", "<!DOCTYPE x>",
)  # fmt: skip
TREES: tuple[Any, ...] = (None, True, False, [], {}, [[]], {"a": {}}, [None], "text", 0, -1, 1e308, float("nan"))


@dataclass(frozen=True, eq=False)
class Target:
    """One kind of input: `run(random)` makes a case, reads it and raises what is not allowed."""

    name: str
    run: Callable[[Random], None]


def must_end_well(work: Callable[[], Any]) -> Any:
    """Return what the work returns, None where it is refused in one line; anything else is raised."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return work()
        except ValuemapError as error:
            said, hint = str(error), error.hint
    assert said, "an error that says nothing"
    assert hint, f"no hint: {said}"
    assert "\n" not in said + hint, said
    return None


# Values, trees, tables and bytes, spoiled.


def hostile_number(random: Random) -> float:
    """Return a number that is seldom thought of."""
    return random.choice(NUMBERS) if random.random() < 0.7 else random.uniform(-1e3, 1e3)


def hostile_text(random: Random) -> str:
    """Return a text that is seldom thought of, or a number as one."""
    return random.choice(TEXTS) if random.random() < 0.6 else str(hostile_number(random))


def hostile_tree(random: Random) -> Any:
    """Return something for the place of another thing in JSON, a new one: what is put in is spoiled further."""
    return random.choice([copy.deepcopy(random.choice(TREES)), hostile_number(random), hostile_text(random)])


def spoil_tree(random: Random, tree: Any) -> Any:
    """Return JSON with one thing in it changed, missing, twice, or in another's place."""
    places: list[tuple[Any, Any]] = []
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        keys = list(node) if isinstance(node, dict) else list(range(len(node))) if isinstance(node, list) else []
        places += [(node, key) for key in keys]
        waiting += [node[key] for key in keys]
    if not places:
        return hostile_tree(random)
    node, key = random.choice(places)
    how = random.randrange(6)
    if how == 0:
        del node[key]
    elif how == 1 and isinstance(node, list):
        node.insert(key, copy.deepcopy(node[key]))
    elif how == 2 and isinstance(node, dict):
        node[hostile_text(random)] = node.pop(key)
    elif how == 3:
        other, there = random.choice(places)
        try:
            node[key] = copy.deepcopy(other[there])
        except (KeyError, IndexError):
            node[key] = None
    else:
        node[key] = hostile_tree(random)
    return tree


def spoil_lines(random: Random, text: str) -> str:
    """Return a table as text with a cell, a row, a column or the separator changed."""
    separator = max(",; \t", key=text.count)
    rows = [line.split(separator) for line in text.split("\n")]
    row = random.randrange(len(rows))
    how = random.randrange(9)
    if how <= 3:
        cell = random.randrange(len(rows[row]))
        rows[row][cell] = hostile_text(random)
    elif how == 4:
        del rows[row][random.randrange(len(rows[row]))]
    elif how == 5:
        rows[row].append(hostile_text(random))
    elif how == 6:
        rows.insert(random.randrange(len(rows) + 1), list(rows[row]))
    elif how == 7:
        del rows[row]
    else:
        separator = random.choice(",; \t|")
    return random.choice(["\n", "\n", "\n", "\r\n", "\r"]).join(separator.join(cells) for cells in rows)


def spoil_bytes(random: Random, content: bytes) -> bytes:
    """Return bytes with some changed, cut, doubled, or a number of 4 or 8 bytes written over them."""
    changed = bytearray(content)
    at = random.randrange(len(changed) + 1)
    how = random.randrange(6)
    if how == 0:
        return bytes(changed[:at])
    if how == 1:
        return bytes(changed[:at] + changed[at : at + 64] + changed[at:])
    if how == 2:
        return bytes(changed[:at] + changed[at + random.randrange(1, 65) :])
    if how == 3:
        changed[at : at + 8] = struct.pack("<d", float(hostile_number(random)))
    elif how == 4:
        number = random.choice([0, 1, 2, 255, 2**31, 2**32 - 1, 2**63, 2**64 - 1])
        changed[at : at + 8] = struct.pack("<Q", number)
    else:
        for _ in range(random.randrange(1, 9)):
            if changed:
                changed[random.randrange(len(changed))] = random.randrange(256)
    return bytes(changed)


def spoil_file(random: Random, name: str, content: bytes) -> bytes:
    """Return a file spoiled after its kind."""
    suffix = Path(name).suffix
    if random.random() < 0.1:
        return spoil_bytes(random, content)
    if suffix == ".json":
        tree = json.loads(content)
        for _ in range(random.randrange(1, 3)):
            tree = spoil_tree(random, tree)
        return json.dumps(tree).encode("utf-8", "surrogatepass")
    if suffix in {".csv", ".txt", ".yaml", ".yml", ".xml"}:
        text = content.decode()
        for _ in range(random.randrange(1, 3)):
            text = spoil_lines(random, text)
        return text.encode("utf-8", "surrogatepass")
    return spoil_bytes(random, content)


# Readers.


@dataclass(frozen=True, eq=False)
class Files:
    """Files of one format in a folder, as they were, and how they are read."""

    folder: Path
    read: Callable[[], Any]
    whole: dict[Path, bytes]

    @classmethod
    def of(cls, folder: Path, read: Callable[[], Any]) -> Files:
        """Take all files that are in a folder now."""
        read()  # Whole, it is read.
        return cls(folder, read, {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()})

    def run(self, random: Random) -> None:
        """Spoil a file or two, read, and put them back."""
        chosen = random.sample(list(self.whole), min(len(self.whole), 1 + (random.random() < 0.2)))
        try:
            for path in chosen:
                path.write_bytes(spoil_file(random, path.name, self.whole[path]))
            dataset = must_end_well(self.read)
            if isinstance(dataset, Dataset):
                check_dataset(dataset, source="what was read")
        finally:
            for path in chosen:
                path.write_bytes(self.whole[path])


def readers(folder: Path) -> list[Target]:
    """Return a target for every reader of poses and of detections."""
    made: dict[str, Files] = {}
    for name, (make, read, _) in poses_of.FORMATS.items():
        here = folder / name
        make(here)
        made[name] = Files.of(here, partial(read, here))
    for kind in DETECTIONS:
        here = folder / f"boxes-{kind}"
        file = boxes_of.detections_in(here, kind)
        made[f"boxes {kind}"] = Files.of(here, partial(boxes_of.read, here, file))
    for text in (False, True):
        here = folder / f"colmap-{text}"
        model = write_model(model_of("OPENCV", names=("a/0.jpg", "a/1.jpg")), here / "model", text=text)
        file = here / "boxes.csv"
        file.write_text("image,x,y,width,height,score\na/0.jpg,300,200,10,20,0.5\na/1.jpg,310,200,10,20,0.5\n")
        made["colmap text" if text else "colmap binary"] = Files.of(here, partial(read_colmap, model, detections=file))
    here = folder / "bearings"
    here.mkdir(parents=True)
    (here / "bearings.csv").write_text("lat,lon,bearing,depth,class\n52,4,10,20,light\n52.0001,4,20,,light\n")
    made["bearings"] = Files.of(here, partial(read_bearings, here / "bearings.csv"))
    here = folder / "kitti-boxes"
    here.mkdir()
    options = write_kitti(here)
    made["kitti boxes"] = Files.of(here, partial(read_kitti, **options))
    here = folder / "csv"
    here.mkdir()
    (here / "poses.csv").write_text(
        "image,x,y,height,qw,qx,qy,qz,pass,timestamp,position_sigma_m\na.jpg,0,0,1,1,0,0,0,p,1,0.1\n"
        "b.jpg,1,0,1,0.6,0.8,0,0,p,2,0.1\n"
    )
    made["csv"] = Files.of(
        here, partial(read_csv_poses, here / "poses.csv", camera="OPENCV 640 480 500 500 320 240 0.1 0 0 0")
    )
    return [Target(name, files.run) for name, files in made.items()]


# Tables of a dataset, on disk and in memory.


def dataset_folder(folder: Path) -> Target:
    """Return the target of datasets as they are on disk: columns of other types, missing, with nulls and nonsense."""
    write_dataset(small_dataset(), folder / "dataset")
    at = folder / "dataset"
    whole = {path: path.read_bytes() for path in at.iterdir() if path.is_file()}
    tables = {path: pq.read_table(path) for path in whole if path.suffix == ".parquet"}

    def run(random: Random) -> None:
        path = random.choice(sorted(whole))
        try:
            if path in tables and random.random() < 0.9:
                pq.write_table(_spoiled_table(random, tables[path]), path)
            else:
                path.write_bytes(spoil_file(random, path.name, whole[path]))
            dataset = must_end_well(lambda: read_dataset(at))
            if dataset is not None:
                _map(dataset, random)
        finally:
            path.write_bytes(whole[path])

    return Target("dataset on disk", run)


def _spoiled_table(random: Random, table: pa.Table) -> pa.Table:
    column = random.randrange(table.num_columns)
    name, values = table.column_names[column], table.column(column).to_pylist()
    how = random.randrange(6)
    if how == 0:
        return table.drop_columns([name])
    if how == 1:
        return table.take(pa.array([random.randrange(table.num_rows) for _ in range(random.randrange(6))], pa.int64()))
    if how == 2:
        texts = [random.choice(TEXTS) for _ in values]
        return table.set_column(column, name, pa.array(texts))
    row = random.randrange(len(values))
    values[row] = random.choice(
        [None, hostile_number(random), random.choice(TEXTS), values[random.randrange(len(values))]]
    )
    try:
        return table.set_column(column, name, pa.array(values, table.schema.field(column).type))
    except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError, TypeError):
        numbers = [hostile_number(random) for _ in values]
        return table.set_column(column, name, pa.array([float(number) for number in numbers]))


def _map(dataset: Dataset, random: Random) -> None:
    method = random.choice(["robust", "paper"])
    settings: list[str] = []
    if random.random() < 0.5:
        name, *_ = random.choice(describe_settings())
        settings.append(f"{name}={hostile_text(random)}")
    config = must_end_well(lambda: MapConfig(method=method).with_settings(settings))  # type: ignore[arg-type]
    if config is None:
        return
    made = must_end_well(lambda: build_map(dataset, config, threads=1))
    if isinstance(made, Map):
        labels = made.labels
        assert np.all(np.isfinite(labels.position_in_world_m))
        assert labels.existence is None or np.all((labels.existence >= 0.0) & (labels.existence <= 1.0))


def hostile_arrays(random: Random) -> None:
    """Map a dataset made in memory, whose arrays hold nonsense, or are of other lengths and types."""
    dataset = small_dataset(Frame(anchor=(52.0, 4.0, 0.0)) if random.random() < 0.3 else None)
    for _ in range(random.randrange(3)):
        name = random.choice(["cameras", "images", "detections", "truth"])
        table = getattr(dataset, name)
        column = random.choice([f.name for f in fields(table)])
        value = _spoiled_column(random, getattr(table, column))
        changed = must_end_well(partial(replace, table, **{column: value}))
        if changed is None:
            return
        dataset = replace(dataset, **{name: changed})
    _map(dataset, random)


def _spoiled_column(random: Random, value: Any) -> Any:
    if isinstance(value, Categories):
        codes = _spoiled_column(random, value.codes)
        return Categories(codes, value.names)
    if isinstance(value, list):
        return [_spoiled_column(random, part) for part in value]
    if not isinstance(value, np.ndarray):
        return value
    changed = value.copy()
    how = random.randrange(5)
    if how == 0:
        return changed[: random.randrange(len(changed) + 1)]
    if how == 1:
        return changed[[random.randrange(len(changed)) for _ in range(len(changed))]] if len(changed) else changed
    if changed.size:
        with np.errstate(all="ignore"):
            number = hostile_number(random)
            is_float = changed.dtype.kind == "f"
            number = number if is_float else int(np.clip(np.nan_to_num(number), -(2**31), 2**31 - 1))
            changed.flat[random.randrange(changed.size)] = number
    return changed


# The border of the core.


def core_border(random: Random) -> None:
    """Call the core with arrays of other lengths, indices beyond the end and numbers that are none."""
    rays, images = random.randrange(1, 12), random.randrange(1, 4)
    # One array in so many is spoiled. What is refused at the door says nothing of what is behind it.
    rate = random.choice([0.0, 0.02, 0.1])

    def length(count: int) -> int:
        return max(0, count + random.choice([-1, 1])) if random.random() < rate / 2 else count

    def floats(*shape: int) -> Any:
        shape = tuple(length(n) for n in shape)
        values = np.array([random.uniform(-5.0, 5.0) for _ in range(int(np.prod(shape)))]).reshape(shape)
        if values.size and random.random() < rate:
            values.flat[random.randrange(values.size)] = float(hostile_number(random))
        return values

    def indices(count: int, below: int, dtype: Any = np.uint32) -> Any:
        values = np.array([random.randrange(max(below, 1)) for _ in range(length(count))], dtype=dtype)
        if values.size and random.random() < rate:
            values[random.randrange(values.size)] = random.choice([below, 2**31, 2**32 - 1])
        return values

    def call(function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        try:
            return function(*arguments, **named)
        except (ValueError, OverflowError, MemoryError):
            return None

    made = call(
        _core.Rays, floats(rays, 3, 3), floats(rays, 3), indices(rays, images), indices(rays, 2), floats(images, 3, 3),
        floats(images, 3),
    )  # fmt: skip
    if made is None:
        return
    count = len(made)
    ends = sorted({random.randrange(1, count + 1) for _ in range(random.randrange(3))} | {count})
    offsets = np.array([0, *ends], dtype=np.int64)
    if random.random() < rate:
        offsets[random.randrange(len(offsets))] = random.choice([-1, 10**9, 2**62, -(2**63)])
    voters, points = np.sort(indices(count, count)), floats(len(offsets) - 1, 3)
    if random.random() < 0.8:
        voters = np.arange(count, dtype=np.uint32)
    which = random.randrange(12)
    if which == 0:
        call(_core.partition, floats(images, 3), float(hostile_number(random)))
    elif which == 1:
        call(
            _core.vote, made, indices(count, 2), max_reprojection_error_px=float(hostile_number(random)),
            min_parallax_rad=float(hostile_number(random)), min_range_m=float(hostile_number(random)),
            max_range_m=float(hostile_number(random)), min_vote_ratio=float(hostile_number(random)),
            min_votes=random.choice([0, 1, 2, 2**32 - 1, 2**40]), threads=1, progress=lambda *_: None,
        )  # fmt: skip
    elif which == 2:
        call(_core.merge, made, points, offsets, voters, indices(len(points), 2), float(hostile_number(random)))
    elif which == 3:
        call(_core.unit_covariance, made, points, offsets, voters)
    elif which == 4:
        call(_core.see, made, points, offsets, voters)
    elif which == 5:
        call(_core.medians, floats(count), offsets)
    else:
        _border_of_scene(random, call, made, count, images, floats, indices, points, offsets, voters)


def _border_of_scene(
    random: Random,
    call: Callable[..., Any],
    made: Any,
    count: int,
    images: int,
    floats: Callable[..., Any],
    indices: Callable[..., Any],
    points: Any,
    offsets: Any,
    voters: Any,
) -> None:
    cameras = random.randrange(1, 3)
    scene = call(
        _core.Scene, made, box_px=floats(count), score=floats(count), range_m=floats(count),
        range_sigma_m=floats(count), center_in_world_m=floats(images, 3), cam_from_world=floats(images, 3, 3),
        camera=indices(images, cameras), pass_code=indices(images, 2), viewpoint=indices(images, 3),
        driven_m=floats(images), position_sigma_m=floats(images), rotation_sigma_rad=floats(images),
        frustum_normals=floats(cameras, 4, 3), solid_angle_sr=floats(cameras),
    )  # fmt: skip
    if scene is None:
        return
    noise = tuple(abs(float(hostile_number(random))) if random.random() < 0.02 else 0.5 for _ in fields(Noise))
    choices: list[tuple[Any, ...]] = [  # The first is good.
        (0.02, 0.0, -1.0, float("nan")), (0.1, 0.0, float("nan"), -1e308), (80.0, 0.0, float("inf"), float("nan")),
        (3.0, 0.0, float("nan"), 1e308), (2, 0, 2**31), (1, 0, 2**31), (0.5, float("nan"), 2.0, -1.0),
        ([], [random.choice(_core.parts())], ["no part"]),
    ]  # fmt: skip
    settings = tuple(values[0] if random.random() < 0.95 else random.choice(values) for values in choices)
    known = ([random.random() < 0.5 for _ in range(3)], random.choice([0.0, 0.5, float(hostile_number(random))]))
    which, quiet = random.randrange(3), lambda *_: None
    if which == 0:
        numbers = sum(count for _, count in _core.CLASS_FIELDS) if random.random() < 0.9 else random.choice([0, 3])
        row = [float(hostile_number(random)) if random.random() < 0.01 else 0.5 for _ in range(numbers)]
        classes = [random.choice([None, row, [1.0]]) for _ in range(random.randrange(3))]
        shares = [[(0, float(hostile_number(random)))] for _ in range(random.randrange(2))]
        call(_core.find_labels, scene, (noise, noise, random.random() < 0.5, classes, row, shares), settings, 1, quiet)
    elif which == 1:
        begin = random.choice([None, (noise, random.randrange(3))])
        call(_core.calibrate, scene, noise, known, settings, random.random() < 0.5, begin, 1, quiet)
    else:
        call(_core.misfits, (scene, scene), indices(count, count), noise, known, settings, 1, quiet)


# Settings.


def settings_texts(random: Random) -> None:
    """Parse settings, and map a good dataset with what is accepted."""
    names = [name for name, *_ in describe_settings()]
    given = [
        (random.choice(names) if random.random() < 0.9 else hostile_text(random))
        + random.choice(["=", "=", "=", "=", "", "=="])
        + hostile_text(random)
        for _ in range(random.randrange(1, 3))
    ]
    method = random.choice(["robust", "paper"])
    config = must_end_well(lambda: MapConfig(method=method).with_settings(given))  # type: ignore[arg-type]
    if config is not None:
        must_end_well(lambda: build_map(small_dataset(), config, threads=1))


@dataclass(eq=False)
class Fuzz:
    """All targets, with their files in a folder."""

    folder: Path
    targets: list[Target] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Make the files."""
        self.targets = [
            *readers(self.folder),
            dataset_folder(self.folder),
            Target("arrays in memory", hostile_arrays),
            Target("settings", settings_texts),
            Target("border of the core", core_border),
        ]
