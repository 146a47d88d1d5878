"""The typed tables that all stages share, and the one way to read, check and write them.

Each table is a frozen dataclass of arrays of one length. Each field says which columns of the file on
disk it stands for, so that reading, validation and writing are one mechanism for all tables. Tables are
held in ascending order of their key, so that nothing depends on the order of rows in a file.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from valuemap.arrays import Floats, Ints, rows_in_runs
from valuemap.arrow import as_type, in_one, numbers_from_arrow, numbers_to_arrow, take_texts, texts_to_arrow
from valuemap.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

_SHOWN_NAMES, _SHOWN_ROWS = 5, 10
ROWS_OF_GROUP = 2**20
"""Rows of a table that are one group in a file: a reader of a part of it reads whole groups."""


@dataclass(frozen=True, eq=False, repr=False)
class Categories:
    """A column of few distinct texts: `names[codes[i]]` is the text of row i; names are sorted."""

    codes: NDArray[np.int32]
    names: tuple[str, ...]

    @classmethod
    def from_texts(cls, texts: Sequence[str] | pa.Array | pa.ChunkedArray) -> Self:
        """Encode texts (N) so that equal columns get equal codes whatever the order of rows."""
        if isinstance(texts, pa.ChunkedArray | pa.Array):
            column = in_one(texts)
            column = column if pa.types.is_dictionary(column.type) else column.dictionary_encode()
            found, codes = column.dictionary.to_pylist(), numbers_from_arrow(column.indices)
        else:
            number: dict[str, int] = {}
            codes = np.array([number.setdefault(text, len(number)) for text in texts], np.int32)
            found = texts_to_arrow(list(number)).to_pylist()  # All can be written.
        is_used = np.bincount(codes.astype(np.int64), minlength=len(found)) > 0
        names = tuple(sorted({name for name, used in zip(found, is_used.tolist(), strict=True) if used}))
        rank = {name: i for i, name in enumerate(names)}
        recode = np.array([rank.get(name, -1) for name in found], dtype=np.int32)
        return cls(recode[codes] if len(codes) else np.empty(0, np.int32), names)

    def __len__(self) -> int:
        return len(self.codes)

    def __repr__(self) -> str:
        shown = ", ".join(map(repr, self.names[:_SHOWN_NAMES]))
        return f"Categories({len(self):,} rows of {shown}{', ...' if len(self.names) > _SHOWN_NAMES else ''})"

    def take(self, rows: NDArray[Any]) -> Categories:
        """Return the rows given by indices or by a mask."""
        return Categories(self.codes[rows], self.names)

    def texts(self) -> list[str]:
        """Return the text of every row."""
        return [self.names[code] for code in self.codes]

    def code_of(self, name: str) -> int:
        """Return the code of a text, or -1 where no row can have it."""
        return self.names.index(name) if name in self.names else -1

    def to_arrow(self) -> pa.Array:
        """Return a dictionary array."""
        return pa.DictionaryArray.from_arrays(numbers_to_arrow(self.codes), texts_to_arrow(self.names))


def _column(kind: str, names: tuple[str, ...], *, optional: bool = False, nullable: bool = False) -> Any:
    """Declare which columns on disk a field stands for.

    kind: "int", "float", "text", "category" or "floats" (a list of numbers a row).
    optional: the whole column may be missing; the field is then None.
    nullable: single values may be missing; they are NaN in memory.
    """
    metadata = {"kind": kind, "names": names, "optional": optional, "nullable": nullable}
    return field(default=None, metadata=metadata) if optional else field(metadata=metadata)


@dataclass(frozen=True, eq=False, repr=False)
class Table:
    """Base of the tables: arrays of one length, sorted by the key column."""

    KEY: ClassVar[str | None] = None
    MAY_BE_EMPTY: ClassVar[bool] = False

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def __getitem__(self, rows: NDArray[Any] | Sequence[int] | Sequence[bool] | slice) -> Self:
        """Return some rows as the same type of table: by a mask, by indices, or by a slice, which copies nothing."""
        if isinstance(rows, slice):
            return type(self)(**{f.name: _cut(getattr(self, f.name), rows) for f in fields(self)})
        if isinstance(rows, int | np.integer):
            raise TypeError(f"a table has no single rows: take [{rows}:{rows + 1}] of it")
        chosen = np.asarray(rows)
        if chosen.dtype == np.bool_ and len(chosen) != len(self):
            raise IndexError(f"a mask of {len(chosen)} rows for a table of {len(self)}")
        return self.take(chosen if len(chosen) else np.empty(0, np.int64))

    def __dir__(self) -> list[str]:
        return [name for name in super().__dir__() if not name.isupper()]  # Constants are for `read_table`.

    def __repr__(self) -> str:
        columns = [name for f in fields(self) if getattr(self, f.name) is not None for name in f.metadata["names"]]
        return f"{type(self).__name__}({len(self):,} rows: {', '.join(columns)})"

    def _repr_html_(self) -> str:
        """Show the first rows in a notebook."""
        rest = f"<p>{len(self):,} rows</p>" if len(self) > _SHOWN_ROWS else ""
        html: str = self[:_SHOWN_ROWS].to_pandas().to_html(index=False, border=0)
        return html + rest

    def to_pandas(self) -> pd.DataFrame:
        """Return the columns as on disk as a data frame of pandas."""
        frame: pd.DataFrame = table_to_arrow(self).to_pandas()
        return frame

    def take(self, rows: NDArray[Any]) -> Self:
        """Return the rows given by indices or by a mask, as the same type of table."""
        return type(self)(**{f.name: _take(getattr(self, f.name), rows) for f in fields(self)})

    def by_key(self) -> Self:
        """Return the rows in ascending order of the key."""
        key: Ints = getattr(self, str(self.KEY))
        return self if np.all(np.diff(key) > 0) else self.take(np.argsort(key, kind="stable"))

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields replaced."""
        return dataclasses.replace(self, **changes)


@dataclass(frozen=True, eq=False, repr=False)
class Cameras(Table):
    """Intrinsics. `model` is a COLMAP model name, `params` in COLMAP's order (pixels, centre of pixel 0 at 0.5).

    `readout_s` is how much later the last row of a picture is exposed than the first one, negative where the last row
    comes first; NaN where all rows are exposed at once. Poses and timestamps are those of the middle row.
    """

    KEY: ClassVar[str | None] = "camera_id"

    camera_id: Ints = _column("int", ("camera_id",))
    model: Categories = _column("category", ("model",))
    width_px: Ints = _column("int", ("width",))
    height_px: Ints = _column("int", ("height",))
    params: list[Floats] = _column("floats", ("params",))
    readout_s: Floats | None = _column("float", ("readout_s",), optional=True, nullable=True)


@dataclass(frozen=True, eq=False, repr=False)
class Images(Table):
    """Exposures: camera, pose, pass and time.

    `cam_from_world_quat` (N, 4) is a unit quaternion w, x, y, z and `cam_from_world_m` (N, 3) a translation:
    point_in_cam = R point_in_world + t, camera axes x right, y down, z forward. Timestamps are seconds. Images with the
    same `rig_id` were taken at one time by the cameras of one car.
    """

    KEY: ClassVar[str | None] = "image_id"

    image_id: Ints = _column("int", ("image_id",))
    name: pa.Array = _column("text", ("name",))
    camera_id: Ints = _column("int", ("camera_id",))
    cam_from_world_quat: Floats = _column("float", ("qw", "qx", "qy", "qz"))
    cam_from_world_m: Floats = _column("float", ("tx", "ty", "tz"))
    pass_id: Categories = _column("category", ("pass_id",))
    rig_id: Ints | None = _column("int", ("rig_id",), optional=True)
    timestamp_s: Floats | None = _column("float", ("timestamp",), optional=True, nullable=True)
    position_sigma_m: Floats | None = _column("float", ("position_sigma_m",), optional=True, nullable=True)
    rotation_sigma_rad: Floats | None = _column("float", ("rotation_sigma_rad",), optional=True, nullable=True)


@dataclass(frozen=True, eq=False, repr=False)
class Detections(Table):
    """2D boxes: centre and size (N, 2) in pixels, class and score; optionally a measured range in metres.

    A size of 0 was not measured (bearings, key points). `vertical_sigma_px` is the standard deviation of the centre's y
    where it is not that of its x (NaN: it is); where no elevation was measured y is the horizon and it is large.
    There are none before `valuemap detect` has looked for them.
    """

    KEY: ClassVar[str | None] = "detection_id"
    MAY_BE_EMPTY: ClassVar[bool] = True

    detection_id: Ints = _column("int", ("detection_id",))
    image_id: Ints = _column("int", ("image_id",))
    class_name: Categories = _column("category", ("class",))
    center_px: Floats = _column("float", ("x", "y"))
    size_px: Floats = _column("float", ("width", "height"))
    score: Floats = _column("float", ("score",))
    range_m: Floats | None = _column("float", ("range_m",), optional=True, nullable=True)
    range_sigma_m: Floats | None = _column("float", ("range_sigma_m",), optional=True, nullable=True)
    vertical_sigma_px: Floats | None = _column("float", ("vertical_sigma_px",), optional=True, nullable=True)

    @classmethod
    def none(cls) -> Self:
        """Return no detections: they are still to be made, or elsewhere."""
        numbers, pairs = np.empty(0, np.int64), np.empty((0, 2))
        return cls(numbers, numbers, Categories(np.empty(0, np.int32), ()), pairs, pairs, np.empty(0))


@dataclass(frozen=True, eq=False, repr=False)
class Truth(Table):
    """Known objects, for evaluation only; positions (N, 3) in metres in the frame of the dataset."""

    KEY: ClassVar[str | None] = "object_id"

    object_id: Ints = _column("int", ("object_id",))
    class_name: Categories = _column("category", ("class",))
    position_in_world_m: Floats = _column("float", ("x", "y", "z"))


@dataclass(frozen=True, eq=False, repr=False)
class TruthPoints(Table):
    """Known objects in a file of the user's own: positions (N, 3) in the frame of the map, the rest if known."""

    position_in_world_m: Floats = _column("float", ("x", "y", "z"))
    class_name: Categories | None = _column("category", ("class",), optional=True)
    object_id: Ints | None = _column("int", ("object_id",), optional=True)
    sigma_m: Floats | None = _column("float", ("sigma",), optional=True, nullable=True)


@dataclass(frozen=True, eq=False, repr=False)
class GeographicTruth(Table):
    """Known objects in a file of the user's own: WGS84 longitude and latitude (N, 2) in degrees, the rest if known."""

    lon_lat: Floats = _column("float", ("lon", "lat"))
    height_m: Floats | None = _column("float", ("height",), optional=True)
    class_name: Categories | None = _column("category", ("class",), optional=True)
    object_id: Ints | None = _column("int", ("object_id",), optional=True)
    sigma_m: Floats | None = _column("float", ("sigma",), optional=True, nullable=True)


@dataclass(frozen=True, eq=False, repr=False)
class TruthDetections(Table):
    """Which object a detection really shows; detections of nothing are not listed."""

    KEY: ClassVar[str | None] = "detection_id"
    MAY_BE_EMPTY: ClassVar[bool] = True

    detection_id: Ints = _column("int", ("detection_id",))
    object_id: Ints = _column("int", ("object_id",))


@dataclass(frozen=True, eq=False, repr=False)
class RejectedRows(Table):
    """Rows that an import left out, in their order: which table they were for, where they stood, and why.

    `center_px`, `size_px` (N, 2) and `score` (N) are what was found, NaN where it was no number or does not apply.
    """

    MAY_BE_EMPTY: ClassVar[bool] = True

    table: Categories = _column("category", ("table",))
    place: pa.Array = _column("text", ("place",))
    reason: Categories = _column("category", ("reason",))
    image_name: pa.Array = _column("text", ("image",))
    class_name: Categories = _column("category", ("class",))
    center_px: Floats = _column("float", ("x", "y"), nullable=True)
    size_px: Floats = _column("float", ("width", "height"), nullable=True)
    score: Floats = _column("float", ("score",), nullable=True)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Points with the rays that support them: what voting finds and merging makes into labels.

    `position_in_world_m` (N, 3); the voters of candidate i are the rows `voters[voter_offsets[i] :
    voter_offsets[i + 1]]` of the detections, ascending. `cluster` (N) is where it was found (paper); `covariance_m2`
    (N, 3, 3), the probability of `existence` (N), the number of images `expected` to see it (N) and the code of its
    class `class_code` (N) are what the robust method adds; without, voters are all of one class.
    """

    position_in_world_m: Floats
    voter_offsets: Ints
    voters: NDArray[np.uint32]
    cluster: NDArray[np.uint32] | None = None
    covariance_m2: Floats | None = None
    existence: Floats | None = None
    expected: Ints | None = None
    class_code: Ints | None = None

    def __len__(self) -> int:
        return len(self.position_in_world_m)

    def take(self, rows: Ints) -> Candidates:
        """Return the candidates given by indices, with their voters."""
        count = np.diff(self.voter_offsets)[rows]
        offsets = np.concatenate([[0], np.cumsum(count)])
        voters = self.voters[rows_in_runs(self.voter_offsets[rows], count)]
        names = ("cluster", "covariance_m2", "existence", "expected", "class_code")
        columns = {name: _take(getattr(self, name), rows) for name in names}
        return Candidates(self.position_in_world_m[rows], offsets, voters, **columns)

    def row_of_voter(self) -> Ints:
        """Return the candidate (row) that each of the voters supports."""
        return np.repeat(np.arange(len(self)), np.diff(self.voter_offsets))


@dataclass(frozen=True, eq=False, repr=False)
class Labels(Table):
    """Accepted objects.

    Positions (N, 3) in metres in the frame of the dataset; covariance (N, 6) in m² as xx, xy, xz, yy, yz, zz;
    `votes` counts images, `passes` the passes they come from; `reprojection_rms_px` over the voters;
    `max_parallax_rad` the largest angle between two voters' directions to the object; `first_seen_s` and
    `last_seen_s` the voters' first and last timestamps (NaN where there are none); width and height from the
    voters' boxes at their depths; `facing_azimuth_rad` (0 to 2 pi, clockwise from north seen from above) where the
    voters' cameras are from it, and `facing_concentration` (0 to 1) how much they are on one side of it;
    `expected` counts the images that should have seen it and `existence` is the
    probability that it exists (robust method); `absolute_covariance_m2` (N, 6) is there where it is known how well the
    whole map is placed, from control points or from how far drives were moved to each other, `covariance_m2` is against
    the labels around; lon, lat in degrees and height in metres
    on WGS84 where geo-referenced; `state` is what `valuemap update` says about it.
    """

    KEY: ClassVar[str | None] = "label_id"
    MAY_BE_EMPTY: ClassVar[bool] = True

    label_id: Ints = _column("int", ("label_id",))
    class_name: Categories = _column("category", ("class",))
    position_in_world_m: Floats = _column("float", ("x", "y", "z"))
    covariance_m2: Floats = _column(
        "float",
        (
            "covariance_xx",
            "covariance_xy",
            "covariance_xz",
            "covariance_yy",
            "covariance_yz",
            "covariance_zz",
        ),
    )
    votes: Ints = _column("int", ("votes",))
    passes: Ints = _column("int", ("passes",))
    object_width_m: Floats = _column("float", ("object_width_m",))
    object_height_m: Floats = _column("float", ("object_height_m",))
    reprojection_rms_px: Floats = _column("float", ("reprojection_rms_px",))
    max_parallax_rad: Floats = _column("float", ("max_parallax_rad",))
    first_seen_s: Floats = _column("float", ("first_seen",), nullable=True)
    last_seen_s: Floats = _column("float", ("last_seen",), nullable=True)
    facing_azimuth_rad: Floats = _column("float", ("facing_azimuth_rad",))
    facing_concentration: Floats = _column("float", ("facing_concentration",))
    absolute_covariance_m2: Floats | None = _column(
        "float",
        (
            "absolute_covariance_xx",
            "absolute_covariance_xy",
            "absolute_covariance_xz",
            "absolute_covariance_yy",
            "absolute_covariance_yz",
            "absolute_covariance_zz",
        ),
        optional=True,
    )
    lon_lat_height: Floats | None = _column("float", ("lon", "lat", "height"), optional=True)
    expected: Ints | None = _column("int", ("expected",), optional=True)
    existence: Floats | None = _column("float", ("existence",), optional=True)
    state: Categories | None = _column("category", ("state",), optional=True)

    @property
    def stated_covariance_m2(self) -> Floats:
        """The covariance (N, 6) of positions in the world, m²: the absolute one where it is known."""
        return self.covariance_m2 if self.absolute_covariance_m2 is None else self.absolute_covariance_m2


def covariance_matrices(covariance_m2: NDArray[Any] | Sequence[float]) -> Floats:
    """Return symmetric matrices (..., 3, 3) of their columns xx, xy, xz, yy, yz, zz (..., 6)."""
    columns = np.asarray(covariance_m2, dtype=np.float64)
    return columns[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*columns.shape[:-1], 3, 3)


def covariance_columns(matrices_m2: Floats) -> Floats:
    """Return the columns xx, xy, xz, yy, yz, zz (N, 6) of symmetric matrices (N, 3, 3)."""
    return matrices_m2.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]


@dataclass(frozen=True, eq=False, repr=False)
class Votes(Table):
    """Which detection supports which label, and how closely: sorted by label, then image."""

    MAY_BE_EMPTY: ClassVar[bool] = True

    label_id: Ints = _column("int", ("label_id",))
    detection_id: Ints = _column("int", ("detection_id",))
    image_id: Ints = _column("int", ("image_id",))
    residual_px: Floats = _column("float", ("residual_px",))
    residual_sigmas: Floats = _column("float", ("residual_sigmas",))


@dataclass(frozen=True, eq=False, repr=False)
class Changes(Table):
    """What became of each label when passes were added to a map, by label id.

    `change` is added, changed, moved, removed or unchanged, `state` that of the label. Positions (N, 3) in metres in
    the frame of the dataset: now, and before (NaN where there was none). The rest is the evidence: in how many `looks`
    the added passes should have seen it, in how many of these they did (`hits`) and did not (`misses`), by how much
    they speak for it (`log_odds`, natural logarithm of the likelihood ratio), and the times of the first and last look.
    """

    MAY_BE_EMPTY: ClassVar[bool] = True

    label_id: Ints = _column("int", ("label_id",))
    change: Categories = _column("category", ("change",))
    state: Categories = _column("category", ("state",))
    class_name: Categories = _column("category", ("class",))
    position_in_world_m: Floats = _column("float", ("x", "y", "z"))
    from_m: Floats = _column("float", ("from_x", "from_y", "from_z"), nullable=True)
    looks: Ints = _column("int", ("looks",))
    hits: Ints = _column("int", ("hits",))
    misses: Ints = _column("int", ("misses",))
    log_odds: Floats = _column("float", ("log_odds",))
    first_look_s: Floats = _column("float", ("first_look",), nullable=True)
    last_look_s: Floats = _column("float", ("last_look",), nullable=True)


@dataclass(frozen=True, eq=False, repr=False)
class IdBridge(Table):
    """Which label of an older map is which of a newer one, and how many votes they have in common."""

    MAY_BE_EMPTY: ClassVar[bool] = True

    old_label_id: Ints = _column("int", ("old_label_id",))
    label_id: Ints = _column("int", ("label_id",))
    common_votes: Ints = _column("int", ("common_votes",))


REJECTION_REASONS: Mapping[str, str] = {
    "votes": "too few images vote for it (min_votes), and what is known of its class does not make up for that",
    "ratio": "it has too few votes for what is usual here (min_vote_ratio)",
    "existence": "it probably does not exist: what votes for it may meet by chance, and too few of the images that "
    "should have seen it did (min_existence)",
    "merged": "it is one object with another label",
    "class": "a label of another class has the place",
    "parallax": "its rays are too parallel to say how far away it is (min_parallax_deg)",
    "range": "it is too near to its cameras or too far from them (min_range_m, max_range_m)",
}
"""Why a hypothesis became no label: the test that it failed, in words."""


@dataclass(frozen=True, eq=False, repr=False)
class Rejected(Table):
    """The best hypotheses that became no labels.

    Positions (N, 3) in metres in the frame of the dataset; `votes` counts images, `passes` the passes they come from,
    `expected` the images that should have seen it; `existence` is NaN where it never came to that test; `reason` is one
    of `REJECTION_REASONS`; `rival` is the label that has its detections or its place, -1 where there is none.
    `value` is what that test looked at and `threshold` what it asks for: votes, degrees, metres, sigmas or a share,
    by the reason; NaN where there is no such number.
    """

    KEY: ClassVar[str | None] = "hypothesis_id"
    MAY_BE_EMPTY: ClassVar[bool] = True

    hypothesis_id: Ints = _column("int", ("hypothesis_id",))
    class_name: Categories = _column("category", ("class",))
    position_in_world_m: Floats = _column("float", ("x", "y", "z"))
    votes: Ints = _column("int", ("votes",))
    passes: Ints = _column("int", ("passes",))
    expected: Ints = _column("int", ("expected",))
    existence: Floats = _column("float", ("existence",), nullable=True)
    reason: Categories = _column("category", ("reason",))
    rival: Ints | None = _column("int", ("rival",), optional=True)
    value: Floats | None = _column("float", ("value",), nullable=True, optional=True)
    threshold: Floats | None = _column("float", ("threshold",), nullable=True, optional=True)


T = TypeVar("T", bound=Table)


def join_tables(tables: Sequence[T]) -> T:
    """Return tables of one kind, at least one, as one, in their order; an optional column stays if all have it."""
    if len(tables) == 1:
        return tables[0]
    columns: dict[str, Any] = {}
    for f in fields(tables[0]):
        values = [getattr(table, f.name) for table in tables]
        if any(value is None for value in values):
            columns[f.name] = None
        elif isinstance(values[0], Categories):
            columns[f.name] = _join_categories(values)
        elif isinstance(values[0], pa.Array):
            columns[f.name] = pa.concat_arrays(values)
        elif isinstance(values[0], list):
            columns[f.name] = [item for value in values for item in value]
        else:
            columns[f.name] = np.concatenate(values)
    return type(tables[0])(**columns)


def in_groups(tables: Iterable[T]) -> Iterator[T]:
    """Yield tables of one kind as others of as many rows as a group in a file has, the last of fewer, in their order.

    So a file is the same however its rows come.
    """
    held: list[T] = []
    count = 0
    for table in tables:
        while count + len(table) > ROWS_OF_GROUP:
            missing = ROWS_OF_GROUP - count
            group = join_tables([*held, table[:missing]])
            held, count, table = [], 0, table[missing:]
            yield group
            del group  # Before the next one is put together.
        held.append(table)
        count += len(table)
    if held:
        yield join_tables(held)


def _join_categories(columns: Sequence[Categories]) -> Categories:
    names_of = {id(column.names): column.names for column in columns}  # Parts of one column share theirs.
    names = tuple(sorted({name for each in names_of.values() for name in each}))
    rank = {name: code for code, name in enumerate(names)}
    recode = {key: np.array([rank[name] for name in each], np.int32) for key, each in names_of.items()}
    codes = [recode[id(column.names)][column.codes] if len(column) else column.codes for column in columns]
    return Categories(np.concatenate(codes), names)


def read_table(kind: type[T], path: Path) -> T:
    """Read and check one Parquet file as a table, rows sorted by its key.

    Raises
    ------
    InputError
        The file is missing, not Parquet or truncated, empty, lacks a column, or holds a wrong type, a
        missing or non-finite value, or a duplicate key; the message names file, row and column.
    """
    return table_from_arrow(kind, read_arrow(path), source=str(path))


def read_arrow(path: Path) -> pa.Table:
    """Read one Parquet file as it is; raises `InputError` where it is missing, damaged or cut short."""
    if not path.is_file():
        raise InputError(f"{path}: no such file", hint="give the folder that an import or simulate command wrote")
    try:
        # Not pq.read_table, which imports pandas before it reads. One thread: others cost more than they save.
        table = pq.ParquetFile(pa.BufferReader(path.read_bytes())).read(use_threads=False)
        table.validate(full=True)  # Finds texts that are not UTF-8, which nothing else would before they are used.
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise not_parquet(path, error) from error
    return table


def not_parquet(path: Path, error: Exception) -> InputError:
    """Return the error of a file that is no whole Parquet."""
    reason = str(error).splitlines()[0]
    return InputError(
        f"{path}: cannot be read as Parquet: {reason}", hint="the file is damaged or cut short: write it again"
    )


def table_from_arrow(kind: type[T], table: pa.Table, *, source: str) -> T:
    """Check an Arrow table and turn it into a typed one, rows sorted by its key; raises as `read_table`."""
    if table.num_rows == 0 and not kind.MAY_BE_EMPTY:
        raise InputError(f"{source}: the table is empty", hint="at least one row is needed: check what wrote the file")
    values = {f.name: _read_field(f.metadata, table, source) for f in fields(kind)}
    result = kind(**values)
    if kind.KEY is None:
        return result
    key: Ints = getattr(result, kind.KEY)
    if np.all(key[1:] > key[:-1]):
        return result
    order = np.argsort(key, kind="stable")
    repeated = np.flatnonzero(np.diff(key[order]) == 0)
    if len(repeated):
        row = int(order[repeated[0] + 1])
        raise InputError(
            f"{source} row {row}: {kind.KEY}: expected unique ids, found {key[row]} again ({len(repeated)} repeated)",
            hint="give every row an id of its own",
        )
    return result.take(order)


def check_table(table: Table, *, source: str) -> None:
    """Check a table that was made by hand as `read_table` checks a file; what is read needs it no more.

    Raises
    ------
    InputError
        A column has another length, shape or type than the table needs, or a value is not finite, or the keys are not
        ascending and unique.
    """
    for f in fields(table):
        value = getattr(table, f.name)
        if value is not None:
            _check_column(value, f, len(table), source)
        elif not f.metadata["optional"]:
            raise InputError(
                f"{source}: {f.name}: expected values, found None", hint="only optional columns may be None"
            )
    if table.KEY is not None:
        key: Ints = getattr(table, table.KEY)
        wrong = np.flatnonzero(np.diff(key) <= 0)
        if len(wrong):
            raise InputError(
                f"{source} row {wrong[0] + 1}: {table.KEY}: expected ascending unique ids, found {key[wrong[0] + 1]} "
                f"after {key[wrong[0]]} ({len(wrong)} rows)",
                hint=f"sort the rows by {table.KEY}",
            )


def _check_column(value: Any, column: dataclasses.Field[Any], rows: int, source: str) -> None:
    names, kind = column.metadata["names"], column.metadata["kind"]
    expected = {"category": Categories, "text": pa.Array, "floats": list}.get(kind, np.ndarray)
    if not isinstance(value, expected):
        raise InputError(
            f"{source}: {column.name}: expected {expected.__name__}, found {type(value).__name__}",
            hint="Categories.from_texts makes a column of texts" if kind == "category" else "see the table's docstring",
        )
    if len(value) != rows:
        raise InputError(
            f"{source}: {column.name}: expected {rows} rows, found {len(value)}",
            hint="all columns need the same length",
        )
    if isinstance(value, Categories):
        _check_codes(value, column.name, source)
    if isinstance(value, list) and not all(_is_row_of_numbers(row) for row in value):
        raise InputError(
            f"{source}: {column.name}: expected an array of numbers in each row",
            hint="np.array([fx, fy, cx, cy], dtype=np.float64), for example",
        )
    if isinstance(value, pa.Array) and (value.null_count or not _is_of_kind(value.type, "text")):
        raise InputError(
            f"{source}: {column.name}: expected texts, found {value.type} with {value.null_count} missing",
            hint="pyarrow.array(texts) makes such a column",
        )
    if not isinstance(value, np.ndarray):
        return
    shape = (rows,) if len(names) == 1 else (rows, len(names))
    if value.shape != shape or value.dtype.kind not in ("f" if kind == "float" else "iu"):
        raise InputError(
            f"{source}: {column.name}: expected {_EXPECTED[kind]} of shape {shape}, "
            f"found {value.dtype} of {value.shape}",
            hint=f"its columns are {', '.join(names)}",
        )
    if kind == "float":
        bad = np.isinf(value) if column.metadata["nullable"] else ~np.isfinite(value)
        if bad.any():
            row = int(np.flatnonzero(bad.reshape(rows, -1).any(axis=1))[0])
            raise InputError(
                f"{source} row {row}: {column.name}: expected finite numbers, found {value[row]}",
                hint="repair or remove it",
            )


def _check_codes(column: Categories, name: str, source: str) -> None:
    codes = column.codes
    is_code = isinstance(codes, np.ndarray) and codes.ndim == 1 and codes.dtype.kind in "iu"
    if not is_code or np.any((codes < 0) | (codes >= len(column.names))):
        raise InputError(
            f"{source}: {name}: expected codes from 0 to {len(column.names) - 1}, one a row",
            hint="Categories.from_texts makes a column of texts",
        )


def _is_row_of_numbers(row: Any) -> bool:
    return isinstance(row, np.ndarray) and row.ndim == 1 and row.dtype.kind == "f"


def table_to_arrow(table: Table) -> pa.Table:
    """Return the columns as on disk; optional fields that are None are left out."""
    columns: dict[str, pa.Array] = {}
    for f in fields(table):
        value = getattr(table, f.name)
        if value is None:
            continue
        names = f.metadata["names"]
        if f.metadata["kind"] == "float":
            for i, name in enumerate(names):
                part = value if value.ndim == 1 else value[:, i]
                columns[name] = numbers_to_arrow(np.asarray(part, np.float64), nullable=f.metadata["nullable"])
        else:
            columns[names[0]] = _to_arrow(value, f.metadata["kind"])
    return pa.table(columns)


def write_table(table: Table, path: Path) -> None:
    """Write a table as Parquet; the same table gives the same bytes."""
    with TableWriter(path) as writer:
        writer.write(table)


_ENCODINGS = {
    pa.int64(): "DELTA_BINARY_PACKED",
    pa.int32(): "DELTA_BINARY_PACKED",
    pa.float64(): "BYTE_STREAM_SPLIT",
    pa.float32(): "BYTE_STREAM_SPLIT",
}
"""Ids mostly ascend, and of numbers side by side the first bytes are alike."""


class TableWriter:
    """Writes a table as Parquet, parts of it one after the other; the first says which columns there are."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> Self:
        self._writer: pq.ParquetWriter | None = None
        self._file = self._path.open("wb")  # Arrow takes no path that is not UTF-8.
        return self

    def write(self, table: Table) -> None:
        """Write the next rows."""
        rows = table_to_arrow(table)
        if self._writer is None:
            # A large city is 9 % smaller than with zstd, written in 57 % and read in 54 % of the time. Dictionaries of
            # all columns made its votes 10 % larger, and took twice as long to write.
            texts = [n for f in fields(table) if f.metadata["kind"] == "category" for n in f.metadata["names"]]
            encodings = {column.name: _ENCODINGS[column.type] for column in rows.schema if column.type in _ENCODINGS}
            self._writer = pq.ParquetWriter(
                self._file, rows.schema, compression="snappy", use_dictionary=texts, column_encoding=encodings
            )
        self._writer.write_table(rows, row_group_size=ROWS_OF_GROUP)

    def __exit__(self, *_: object) -> None:
        with self._file:
            if self._writer is not None:
                self._writer.close()


def _cut(value: Any, rows: slice) -> Any:
    if value is None:
        return None
    return Categories(value.codes[rows], value.names) if isinstance(value, Categories) else value[rows]


def _take(value: Any, rows: NDArray[Any]) -> Any:
    if value is None:
        return None
    if isinstance(value, Categories):
        return value.take(rows)
    if isinstance(value, pa.Array):
        indices = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows
        return take_texts(value, indices)
    if isinstance(value, list):
        return [value[i] for i in (np.flatnonzero(rows) if rows.dtype == np.bool_ else rows)]
    # A fraction of the time of value[rows] where a row has several numbers.
    return value.take(np.flatnonzero(rows) if rows.dtype == np.bool_ else rows, axis=0)


def _to_arrow(value: Any, kind: str) -> pa.Array:
    if kind == "category":
        return value.to_arrow()
    if kind == "floats":
        offsets = np.cumsum([0, *map(len, value)], dtype=np.int32)
        items = numbers_to_arrow(np.concatenate([*value, np.empty(0)]))
        return pa.ListArray.from_arrays(numbers_to_arrow(offsets), items)
    return value if isinstance(value, pa.Array) else numbers_to_arrow(np.asarray(value, np.int64))


_EXPECTED = {
    "int": "whole numbers",
    "float": "numbers",
    "text": "texts",
    "category": "texts",
    "floats": "a list of numbers a row",
}


def _read_field(column: Any, table: pa.Table, source: str) -> Any:
    names, kind = column["names"], column["kind"]
    missing = [name for name in names if name not in table.column_names]
    if missing:
        if column["optional"] and len(missing) == len(names):
            return None
        raise InputError(
            f"{source}: column {missing[0]!r} is missing; found {', '.join(table.column_names)}",
            hint=f"add the column {missing[0]!r} ({_EXPECTED[kind]})",
        )
    twice = [name for name in names if table.column_names.count(name) > 1]
    if twice:
        raise InputError(f"{source}: column {twice[0]!r} is there twice", hint="keep one of them")
    parts = [_read_column(table.column(name), name, column, source) for name in names]
    return parts[0] if len(parts) == 1 else np.stack(parts, axis=1)


def _read_column(column: pa.ChunkedArray, name: str, spec: Any, source: str) -> Any:
    kind, nullable = spec["kind"], spec["nullable"]
    if not _is_of_kind(column.type, kind):
        raise InputError(
            f"{source}: column {name!r}: expected {_EXPECTED[kind]}, found {column.type}",
            hint=f"write {name!r} with another type",
        )
    if pa.types.is_dictionary(column.type) and (
        kind != "category" or any(chunk.dictionary.null_count for chunk in column.chunks)
    ):
        column = column.cast(column.type.value_type)  # What is missing in the dictionary is so in the rows.
    if column.null_count and not nullable:
        row = int(np.flatnonzero(column.is_null().to_numpy())[0])
        raise InputError(
            f"{source} row {row}: {name}: expected a value, found none ({column.null_count} rows)",
            hint="fill the value in, or remove the row",
        )
    if kind == "category":
        return Categories.from_texts(column)
    if kind == "text":
        return in_one(as_type(column, pa.string()))
    if kind == "floats":
        return [np.asarray(row, dtype=np.float64) for row in column.to_pylist()]
    if kind == "int":
        return _numbers(column, pa.int64(), name, source)
    values: Floats = _numbers(column, pa.float64(), name, source)
    bad = np.flatnonzero(np.isinf(values) if nullable else ~np.isfinite(values))
    if len(bad):
        row = int(bad[0])
        raise InputError(
            f"{source} row {row}: {name}: expected a finite number, found {values[row]} ({len(bad)} rows)",
            hint="repair or remove the row",
        )
    return values


def _numbers(column: pa.ChunkedArray, kind: pa.DataType, name: str, source: str) -> NDArray[Any]:
    try:
        return numbers_from_arrow(as_type(column, kind))
    except pa.ArrowInvalid as error:
        raise InputError(
            f"{source}: column {name!r}: expected numbers that {kind} can hold: {error}",
            hint="are these ids below 2^63, timestamps in seconds?",
        ) from error


def _is_of_kind(kind_found: pa.DataType, kind: str) -> bool:
    types = pa.types
    if types.is_dictionary(kind_found):
        return kind in ("text", "category") and _is_of_kind(kind_found.value_type, kind)
    if kind == "int":
        return bool(types.is_integer(kind_found))
    if kind == "float":
        return bool(types.is_integer(kind_found) or types.is_floating(kind_found) or types.is_null(kind_found))
    if kind == "floats":
        is_list = types.is_list(kind_found) or types.is_large_list(kind_found) or types.is_fixed_size_list(kind_found)
        return bool(is_list and _is_of_kind(kind_found.value_type, "float"))
    return bool(types.is_string(kind_found) or types.is_large_string(kind_found))
