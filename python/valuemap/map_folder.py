"""A map: the folder of labels, votes and the record of the run that `valuemap map` writes."""

from __future__ import annotations

import base64
import html
import io
import json
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Bools
from valuemap.dataset import Dataset, Frame
from valuemap.errors import InputError, check_kind
from valuemap.folders import DATASET_MARKER, MAP_MARKER, new_folder, settle, take_over, why_not_there
from valuemap.remote import Place, name_of, read_all
from valuemap.tables import Labels, Rejected, Votes
from valuemap.tables.read import read_table
from valuemap.tables.table import table_to_arrow
from valuemap.tables.write import write_table

if TYPE_CHECKING:
    import geopandas
    import pandas as pd
    from matplotlib.figure import Figure

MARKER = MAP_MARKER
REVIEW = "review.json"
"""What people decided about the labels (`valuemap.review`): the one file that a new map in the same folder keeps."""
CALIBRATION = "calibration.json"
"""What was estimated of the dataset before any part of it was mapped."""
CELLS = "cells"
"""The folder of what was found in each cell, which an update of the map starts from."""
CHANGES, BRIDGE = "changes.parquet", "bridge.parquet"
"""What an update of a map says: what became of each label, and which ids it had."""
DATASET = "dataset"
"""The folder of an updated map that holds the dataset with the passes that were added."""
REJECTED = "rejected.parquet"
"""The hypotheses that became no labels, where the map keeps them."""
PARTS = (MARKER, "labels.parquet", "votes.parquet", REJECTED, CALIBRATION, CHANGES, BRIDGE)
"""All files that a map may have: none of an older one may stay beside those of a new one."""
PART_FOLDERS = (CELLS, DATASET)
"""Folders of it whose files, as far as valuemap wrote them, are of that map alone."""

_RECORD: dict[str, tuple[type, str]] = {
    "dataset": (str, "a text"),
    "settings": (dict, "an object"),
    "settings_not_given": (list, "a list"),
    "counts": (dict, "an object"),
    "stages": (list, "a list"),
    "notes": (list, "a list"),
    "poses": (dict, "an object"),
    "control": (dict, "an object"),
}


@dataclass(frozen=True, eq=False, repr=False)
class Map:
    """Labels with their evidence, in the frame of the dataset they come from.

    `run` is what run.json holds: version, dataset, settings, counts of everything found and rejected, and
    seconds and peak memory per stage. `corrected` is the dataset with the poses and cameras that the labels were
    found with, where those that were given had faults and it was just mapped; None else. `rejected` are the best
    hypotheses that became no labels; None where the map keeps none.
    """

    frame: Frame
    labels: Labels
    votes: Votes
    run: dict[str, Any]
    corrected: Dataset | None = None
    rejected: Rejected | None = None

    def __repr__(self) -> str:
        classes = len(np.unique(self.labels.class_name.codes))
        of = "1 class" if classes == 1 else f"{classes} classes"
        return f"Map({len(self.labels):,} labels of {of}, {len(self.votes):,} votes)"

    def _repr_html_(self) -> str:
        """Show the map in a notebook: in numbers, and from above."""
        picture = base64.b64encode(self._picture()).decode("ascii")
        return (
            f"<p>{html.escape(repr(self))}</p>"
            f'<img alt="The map from above" style="max-width:100%" src="data:image/png;base64,{picture}">'
        )

    def _picture(self) -> bytes:
        buffer = io.BytesIO()
        self.plot().savefig(buffer, format="png", dpi=60)
        return buffer.getvalue()

    def plot(self, dataset: Dataset | None = None) -> Figure:
        """Return the map from above as a figure of matplotlib; with the dataset also the streets that were driven."""
        from valuemap import plot_map  # Draws with a library that nothing else of a map needs.

        return plot_map(self, dataset)

    @property
    def method(self) -> str:
        """The name of the method that made the map; ? where its record does not say it."""
        return str(self.run.get("settings", {}).get("method", "?"))

    def setting(self, name: str, otherwise: float) -> float:
        """Return a number that the run which made the map was set to, `otherwise` where its record has none."""
        value = self.run.get("settings", {}).get(name)
        return float(value) if isinstance(value, int | float) else otherwise

    @property
    def is_there(self) -> Bools:
        """Which labels (N) no update found to be gone."""
        state = self.labels.state
        if state is None:
            return np.ones(len(self.labels), np.bool_)
        return np.asarray(state.codes != state.code_of("gone"))

    def take(self, rows: NDArray[Any]) -> Map:
        """Return the map with those labels only that indices or a mask give, and their votes."""
        labels = self.labels[rows].by_key()
        votes = self.votes.take(np.isin(self.votes.label_id, labels.label_id))
        return replace(self, labels=labels, votes=votes)

    def to_pandas(self) -> pd.DataFrame:
        """Return the labels as a data frame of pandas, with their columns on disk."""
        return self.labels.to_pandas()

    def to_geopandas(self) -> geopandas.GeoDataFrame:
        """Return the labels of a geo-referenced map as points lon, lat, height.

        Raises
        ------
        InputError
            The map is not geo-referenced.
        """
        if self.labels.lon_lat_height is None:
            raise InputError(
                "the map is not geo-referenced: its labels have no place on the Earth", hint="use to_pandas"
            )
        return geographic_labels(self.labels)


def write_map(
    result: Map,
    path: str | Path,
    *,
    cells: Sequence[Place] = (),
    files: Mapping[str, Path] = MappingProxyType({}),
    force: bool = False,
) -> None:
    """Write a map as a folder; an older map that is there is replaced, never half.

    Other files in the folder stay. Where one that valuemap did not write is in the way, an `OutputError` says so; with
    `force` it is replaced. `cells` are the files of its cells, `files` others by their names in the folder,
    which nobody changes any more: where the disk knows links they are linked, else copied, and so are cells.
    """
    expect_map(result)
    with new_folder(Path(path), parts=PARTS, part_folders=PART_FOLDERS, force=force) as folder:
        run = {**result.run, "frame": result.frame.to_json()}
        calibration = run.pop("calibration", None)
        if calibration is not None:
            (folder / CALIBRATION).write_text(json.dumps(calibration, indent=2) + "\n", encoding="utf-8")
        if cells:
            (folder / CELLS).mkdir()
        afar = [cell for cell in cells if not isinstance(cell, Path)]
        here = {cell: folder / CELLS / cell.name for cell in cells if isinstance(cell, Path)}
        take_over({file: folder / name for name, file in files.items()} | here)
        for cell, content in zip(afar, read_all(afar), strict=True):
            (folder / CELLS / name_of(cell)).write_bytes(content)
        (folder / MARKER).write_text(json.dumps(run, indent=2) + "\n", encoding="utf-8")
        write_labels(result, folder / "labels.parquet")
        write_table(result.votes, folder / "votes.parquet")
        if result.rejected is not None:
            write_table(result.rejected, folder / REJECTED)


def read_map(path: str | Path) -> Map:
    """Read and check a map folder.

    Raises
    ------
    InputError
        The folder is not a map, or a file in it is damaged.
    """
    check_kind("map", path, (str, Path), "the folder of a map", hint='for example read_map("my-map")')
    folder = Path(path)
    run = read_record(folder)
    if (folder / CALIBRATION).is_file():
        run["calibration"] = read_json(folder / CALIBRATION)
    labels, votes = read_table(Labels, folder / "labels.parquet"), read_table(Votes, folder / "votes.parquet")
    # Who removes labels from the table, as a filter in pandas does, need not know of their votes.
    known = np.isin(votes.label_id, labels.label_id)
    votes = votes if known.all() else votes.take(known)
    rejected = read_table(Rejected, folder / REJECTED) if (folder / REJECTED).is_file() else None
    frame = Frame.from_json(run.pop("frame", None), source=str(folder / MARKER))
    return Map(frame=frame, labels=labels, votes=votes, run=run, rejected=rejected)


def expect_map(result: object) -> None:
    """Refuse what is no `Map`, where a function takes nothing else; raises `InputError`."""
    check_kind("map", result, Map, "a Map", hint="build_map makes one, read_map reads one from its folder")


def read_record(folder: Path) -> dict[str, Any]:
    """Read what run.json of a map says; raises `InputError` where the folder is no map."""
    head = folder / MARKER
    settle(folder)
    if not head.is_file():
        if (folder / DATASET_MARKER).is_file():
            raise InputError(f"{folder}: is a dataset, not a map", hint=f"valuemap map {folder} makes a map of it")
        raise InputError(f"{folder}: is not a map: {why_not_there(folder, MARKER)}", hint="make one with valuemap map")
    run = read_json(head)
    _check_run(run, str(head))
    return run


def read_json(path: Path) -> dict[str, Any]:
    """Read an object from a file of a map; raises `InputError` where it holds something else."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as JSON: {error}", hint="make the map again") from error
    if not isinstance(value, dict):
        raise InputError(f"{path}: expected a JSON object, found {type(value).__name__}", hint="make the map again")
    return value


def _check_run(run: dict[str, Any], source: str) -> None:
    """Refuse a record whose entries are not what everything that reads it takes them for."""
    for name, (kind, expected) in _RECORD.items():
        if not isinstance(run.get(name, kind()), kind):
            raise InputError(
                f"{source}: {name}: expected {expected}, found {reprlib.repr(run[name])}", hint="make the map again"
            )
    for stage in run.get("stages", []):
        if not isinstance(stage, dict) or not isinstance(stage.get("seconds"), int | float):
            raise InputError(
                f"{source}: stages: expected objects with seconds, found {reprlib.repr(stage)}",
                hint="make the map again",
            )


def write_labels(result: Map, path: Path) -> None:
    """Write the labels as Parquet; as GeoParquet (points lon, lat, height) where geo-referenced."""
    if result.labels.lon_lat_height is None:
        write_table(result.labels, path)
        return
    geographic_labels(result.labels).to_parquet(path, compression="zstd")


def geographic_labels(labels: Labels) -> geopandas.GeoDataFrame:
    """Return geo-referenced labels as a data frame with their columns on disk and points lon, lat, height."""
    import geopandas  # Slow to import, and only geo-referenced maps need it.

    assert labels.lon_lat_height is not None
    points = geopandas.points_from_xy(*labels.lon_lat_height.T)
    frame = table_to_arrow(labels).to_pandas()
    frame = frame.astype({"class": "string"})  # No labels have no classes, and categories of none have no type.
    return geopandas.GeoDataFrame(frame, geometry=points, crs="EPSG:4979")
