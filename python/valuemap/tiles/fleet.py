"""The driving order of a dataset that is larger than memory: told batch by batch, of passes that belong together.

Only passes that were driven at one time and near each other can be of one vehicle. So passes that overlap in time are
one group if the boxes around them are no farther apart than the larger of them is wide. Groups are put into batches,
and each batch is put into driving order by itself. What is usual among all vehicles is gathered before drives are cut.

Images without a time that tells an order are told apart by their names, all of them together: they are one batch.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.cameras import camera_centers
from valuemap.connected import connected
from valuemap.drives import Drives, Usual, Ways, are_dates, driving_order
from valuemap.portions import DatasetReader
from valuemap.progress import Progress
from valuemap.tables import Categories, Images
from valuemap.tables.read import read_table
from valuemap.tables.table import join_tables
from valuemap.tables.write import TableWriter

BATCH = 400_000
"""About as many images are put into order at a time: 0.2 GB. A group that has more is a batch nevertheless."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Some images in driving order, with their drives among those of all; `place` (N) is where in it they are."""

    images: Images
    drives: Drives
    place: Ints


class Fleet:
    """The images of a dataset in driving order, in batches that are kept in a folder."""

    def __init__(self, reader: DatasetReader, folder: Path, *, viewpoint_step_m: float, progress: Progress) -> None:
        self._folder, self._viewpoint_step_m, self._progress = folder, viewpoint_step_m, progress
        folder.mkdir()
        passes = _Passes.of(reader)
        self._pass_names = passes.names
        self.count = int(passes.images.sum())
        self._files = self._split(reader, passes)
        self._starts = self._cut()
        self.record = self._starts.record(passes)

    def batches(self) -> Iterator[Batch]:
        """Yield all images; the passes are named by their numbers, which are as those of the whole dataset."""
        starts = self._starts
        code_of = {name: code for code, name in enumerate(self._pass_names)}
        for number, file in enumerate(self._files):
            images = read_table(Images, file)
            codes = np.array([code_of[name] for name in images.pass_id.names], np.int32)[images.pass_id.codes]
            images = images.replace(pass_id=Categories(codes, tuple(self._pass_names)))
            with np.load(_cuts_of(file)) as found:
                drive = found["drive"] + starts.first_of_batch[number]
                place = starts.place[drive] + found["place"]
                along = np.argsort(place)
                drives = Drives(
                    pass_code=starts.rank[drive][along],
                    order=found["order"][along],
                    driven_m=found["driven_m"][along],
                    viewpoint=(starts.viewpoint[drive] + found["viewpoint"])[along],
                    record={},
                )
            yield Batch(images.take(along), drives, place[along])

    def _split(self, reader: DatasetReader, passes: _Passes) -> list[Path]:
        """Write the images into a file a batch; those that no time orders are the last."""
        batch_of_pass = passes.batches()
        count = int(batch_of_pass.max(initial=-1)) + 1
        files = [self._folder / f"{number}.parquet" for number in range(count + 1)]
        code_of = {name: code for code, name in enumerate(passes.names)}
        done = 0
        with ExitStack() as opened:
            writers = [opened.enter_context(TableWriter(file)) for file in files]
            self._progress("reading images", 0, self.count)
            for images in reader.images():
                of = batch_of_pass[np.array([code_of[name] for name in images.pass_id.names])[images.pass_id.codes]]
                is_untimed = _is_untimed(images)
                # Rigs may tie images with a time to others without.
                if images.rig_id is not None and passes.untimed.any():
                    is_untimed[:] = True
                of = np.where(is_untimed, count, of)
                for number in np.unique(of).tolist():
                    writers[number].write(images.take(np.flatnonzero(of == number)))
                done += len(images)
                self._progress("reading images", done, self.count)
        last = [read_table(Images, files[-1])] if files[-1].stat().st_size else []
        for file in files[:-1]:
            if not file.stat().st_size:
                continue
            images = read_table(Images, file)
            dated = are_dates(images)
            if dated.any():
                last.append(images.take(np.flatnonzero(dated)))
                file.unlink()
                if not dated.all():
                    with TableWriter(file) as writer:
                        writer.write(images.take(np.flatnonzero(~dated)))
        if len(last) > 1:
            files[-1].unlink()
        if last and not (files[-1].is_file() and files[-1].stat().st_size):
            with TableWriter(files[-1]) as writer:
                writer.write(join_tables(last))
        return [file for file in files if file.is_file() and file.stat().st_size]

    def _cut(self) -> _Starts:
        """Cut all ways into drives, by what is usual among all of them."""
        usual: Usual | None = None
        ways: Ways | None = None
        total = 2 * len(self._files)
        self._progress("ordering drives", 0, total)
        for done, file in enumerate(self._files):
            ways = Ways(read_table(Images, file))
            usual = ways.usual if usual is None else usual + ways.usual
            self._progress("ordering drives", done + 1, total)
        assert usual is not None
        parts = []
        for done, file in enumerate(self._files):
            images = read_table(Images, file)
            if ways is None or len(self._files) > 1:
                ways = Ways(images)
            drives, first = ways.drives(usual, viewpoint_step_m=self._viewpoint_step_m)
            ways = None
            parts.append(_Starts.of(images, drives, first))
            rows = driving_order(images, drives)
            place = np.empty(len(rows), np.int64)
            place[rows] = np.arange(len(rows))
            begin = np.concatenate([[0], np.cumsum(parts[-1].images)[:-1]])
            np.savez(
                _cuts_of(file),
                drive=drives.pass_code,
                place=place - begin[drives.pass_code],
                order=drives.order,
                driven_m=drives.driven_m,
                viewpoint=drives.viewpoint - parts[-1].first_viewpoint[drives.pass_code],
            )
            self._progress("ordering drives", len(self._files) + done + 1, total)
        return _Starts.joined(parts)


def _cuts_of(file: Path) -> Path:
    return file.with_suffix(".npz")


def _is_untimed(images: Images) -> Bools:
    if images.timestamp_s is None:
        return np.ones(len(images), np.bool_)
    return np.isnan(images.timestamp_s)


@dataclass(frozen=True, eq=False)
class _Starts:
    """The drives (D) of batches one after the other: what they have of each, and how their first images compare."""

    images: Ints
    viewpoints: Ints
    first_viewpoint: Ints
    keys: Floats
    """Time, place (3) and direction (4) of the first image (D, 8)."""
    names: list[str]
    records: list[dict[str, Any]]
    first_of_batch: list[int]
    rank: Ints
    place: Ints
    viewpoint: Ints

    @classmethod
    def of(cls, images: Images, drives: Drives, first: Ints) -> _Starts:
        """Return the drives of one batch; their first images are the rows `first`."""
        count = np.bincount(drives.pass_code, minlength=drives.count)
        viewpoint, row = np.unique(drives.viewpoint, return_index=True)
        of = drives.pass_code[row]
        first_viewpoint = np.full(drives.count, len(viewpoint))
        np.minimum.at(first_viewpoint, of, viewpoint)
        start, dated = images.take(first), are_dates(images)[first]
        time_s = np.where(dated, np.nan, np.nan if start.timestamp_s is None else start.timestamp_s)
        return cls(
            images=count,
            viewpoints=np.bincount(of, minlength=drives.count),
            first_viewpoint=first_viewpoint,
            keys=np.column_stack([time_s, camera_centers(start), start.cam_from_world_quat]),
            names=list(start.name.to_pylist()),
            records=[drives.record],
            first_of_batch=[0],
            rank=np.arange(drives.count),
            place=np.cumsum(count) - count,
            viewpoint=first_viewpoint,
        )

    @classmethod
    def joined(cls, parts: list[_Starts]) -> _Starts:
        """Return the drives of all batches, numbered by their first time, then place, as `find_drives` does."""
        keys = np.concatenate([part.keys for part in parts])
        names = [name for part in parts for name in part.names]
        order = np.lexsort((np.unique(np.array(names), return_inverse=True)[1], *keys.T[::-1]))
        rank = np.empty(len(order), np.int64)
        rank[order] = np.arange(len(order))
        images, viewpoints = (np.concatenate([getattr(part, n) for part in parts]) for n in ("images", "viewpoints"))
        place, viewpoint = (np.empty(len(order), np.int64) for _ in range(2))
        place[order] = np.cumsum(images[order]) - images[order]
        viewpoint[order] = np.cumsum(viewpoints[order]) - viewpoints[order]
        sizes = np.array([len(part.images) for part in parts])
        return cls(
            images=images,
            viewpoints=viewpoints,
            first_viewpoint=np.concatenate([part.first_viewpoint for part in parts]),
            keys=keys,
            names=names,
            records=[part.records[0] for part in parts],
            first_of_batch=(np.cumsum(sizes) - sizes).tolist(),
            rank=rank,
            place=place,
            viewpoint=viewpoint,
        )

    def record(self, passes: _Passes) -> dict[str, Any]:
        """Return what was found about drives, as `Drives.record`."""
        totals: dict[str, Any] = {"passes": len(passes.names), "drives": len(self.images)}
        for name in ("cut_at", "images_ordered_by"):
            reasons = {reason for record in self.records for reason in record[name]}
            in_order = [
                reason for reason in ("pauses", "jumps", "revisits", "time", "name", "chain") if reason in reasons
            ]
            totals[name] = {reason: sum(record[name].get(reason, 0) for record in self.records) for reason in in_order}
        for name in ("rigs", "images_on_rigs"):
            totals[name] = sum(record[name] for record in self.records)
        return totals


@dataclass(frozen=True, eq=False)
class _Passes:
    """The passes (P) of a dataset by name: when and where they were driven; times are NaN where none is known."""

    names: list[str]
    images: Ints
    untimed: Ints
    first_s: Floats
    last_s: Floats
    low_m: Floats
    high_m: Floats

    @classmethod
    def of(cls, reader: DatasetReader) -> _Passes:
        number: dict[str, int] = {}
        parts: list[tuple[Any, ...]] = []
        for images in reader.images():
            found = np.unique(images.pass_id.codes)
            codes = np.array([number.setdefault(images.pass_id.names[code], len(number)) for code in found.tolist()])
            of = np.searchsorted(found, images.pass_id.codes)
            untimed = _is_untimed(images)
            time_s = np.full(len(images), np.nan) if images.timestamp_s is None else images.timestamp_s
            center_m = camera_centers(images)
            first_s, last_s = np.full(len(found), np.inf), np.full(len(found), -np.inf)
            low_m, high_m = np.full((len(found), 3), np.inf), np.full((len(found), 3), -np.inf)
            np.fmin.at(first_s, of, time_s)
            np.fmax.at(last_s, of, time_s)
            np.minimum.at(low_m, of, center_m)
            np.maximum.at(high_m, of, center_m)
            parts.append((codes, np.bincount(of), np.bincount(of, untimed), first_s, last_s, low_m, high_m))
        names = list(number)
        order = sorted(range(len(names)), key=names.__getitem__)
        rank = np.empty(len(names), np.int64)
        rank[order] = np.arange(len(names))
        code, images_of, untimed_of, first, last, low, high = (
            np.concatenate(column) for column in zip(*parts, strict=True)
        )
        of_all = cls(
            names=[names[i] for i in order],
            images=np.bincount(rank[code], images_of, len(names)).astype(np.int64),
            untimed=np.bincount(rank[code], untimed_of, len(names)).astype(np.int64),
            first_s=np.full(len(names), np.inf),
            last_s=np.full(len(names), -np.inf),
            low_m=np.full((len(names), 3), np.inf),
            high_m=np.full((len(names), 3), -np.inf),
        )
        np.minimum.at(of_all.first_s, rank[code], first)
        np.maximum.at(of_all.last_s, rank[code], last)
        np.minimum.at(of_all.low_m, rank[code], low)
        np.maximum.at(of_all.high_m, rank[code], high)
        return of_all

    def batches(self) -> Ints:
        """Return the batch (P) of the images with a time of each pass."""
        group = self._groups()
        order = np.argsort(self.first_s, kind="stable")
        batch_of_group: dict[int, int] = {}
        size = np.bincount(group, self.images, len(group))
        room, number = 0.0, -1
        for of in group[order].tolist():
            if of not in batch_of_group:
                if number < 0 or size[of] > room:
                    number, room = number + 1, float(BATCH)
                batch_of_group[of] = number
                room -= size[of]
        return np.array([batch_of_group[of] for of in group.tolist()], np.int64)

    def _groups(self) -> Ints:
        """Return which passes (P) may be of one vehicle, by the lowest of them."""
        pairs: list[Ints] = []
        width_m = np.linalg.norm(self.high_m - self.low_m, axis=1)
        driving = np.empty(0, np.int64)
        for here in np.argsort(self.first_s, kind="stable").tolist():
            if not np.isfinite(self.first_s[here]):
                break
            driving = driving[self.last_s[driving] >= self.first_s[here]]
            apart_m = np.maximum(self.low_m[driving] - self.high_m[here], self.low_m[here] - self.high_m[driving])
            near = driving[apart_m.max(axis=1) <= np.maximum(width_m[driving], width_m[here])]
            pairs.append(np.stack([np.full(len(near), here), near]))
            driving = np.append(driving, here)
        one, other = np.concatenate([np.empty((2, 0), np.int64), *pairs], axis=1)
        return connected(one, other, len(self.names))
