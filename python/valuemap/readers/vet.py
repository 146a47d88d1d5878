"""Which of the boxes and images that a reader found can be used: the rest is left out, listed and counted, not lost."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from valuemap.arrays import Bools, Floats, Ints
from valuemap.errors import InputError, SettingError
from valuemap.readers import row_file
from valuemap.readers.boxes import CROWD, NO_ANGLE, NO_BOX, NOTHING, FiledBoxes, are_distinct, structure
from valuemap.readers.names import ambiguous, match_images, same_but_for_zeros
from valuemap.readers.row_file import PartFile, RowFile, Rows, bounds_by_count
from valuemap.tables import Cameras, Categories, Detections, Images, RejectedRows

MAX_REJECTED = 0.01
"""An import stops where a larger share of the boxes, or of the images, cannot be used."""

_QUATERNION_TOLERANCE = 1e-3
_MAX_SIZE_OF_PICTURE = 2.0
_FARTHEST_M = 1e8
"""Beyond the Earth and all that people count positions on it from, in metres."""
_SHOWN_REASONS = 3


@dataclass(frozen=True)
class _Reason:
    """Why a row cannot be used, and what the user can do if many are of this kind.

    Where it is no fault of the row it does not count toward the share at which an import stops.
    """

    text: str
    hint: str
    counts: bool = True


_NO_CLASS = _Reason(
    "its class is missing, or not in the list of classes", "give every box a class, and every class a name"
)
_NOT_FINITE = _Reason("a number is missing or not finite", "repair these rows in the file")
_NO_SIZE = _Reason(
    "its width or height is not above 0",
    "do the boxes hold what the format says: corners, or a corner and a size?",
)
_TOO_LARGE = _Reason(
    f"it is more than {_MAX_SIZE_OF_PICTURE:g} times as large as its picture",
    "are the boxes in pixels of the pictures that the cameras are of?",
)
_OUTSIDE = _Reason(
    "its centre lies outside its picture",
    "are the boxes in pixels of the pictures that the cameras are of, and in the order that the format says?",
)
_SCORE = _Reason("its score is not from 0 to 1", "scores are probabilities: divide percentages by 100")
_RANGE = _Reason("its range or a sigma is not above 0", "ranges are metres; leave unknown ones empty")
_TWICE = _Reason("the same box is there already", "was the file put together from parts that overlap?")
# What people mark so, and draw for other ends, is no fault; but an angle that is none.
_OF_ENTRY = {
    NO_ANGLE: _Reason("its bearing is more than a turn", "bearings are degrees clockwise from north, from -360 to 360"),
    CROWD: _Reason(
        "it is marked as a crowd: a region of many objects", "mark every object with a box of its own", counts=False
    ),
    NO_BOX: _Reason("it is a shape without a box, such as points or a line", "draw boxes or polygons", counts=False),
    NOTHING: _Reason(
        "its row is empty but for the image: nothing is in the picture", "did the detector find anything?", counts=False
    ),
}
# What goes with its image is the image's fault, which was counted.
_LEFT_OUT = _Reason("its image was left out", "repair the image first", counts=False)
_NOT_CHOSEN = _Reason(
    "its image is one that the options of the import leave out",
    "choose the images that the boxes are of, or boxes of the images that are chosen",
    counts=False,
)
_POSE_NOT_FINITE = _Reason("a number of its pose is missing or not finite", "repair the poses of these images")
_NO_ROTATION = _Reason(
    "its quaternion is not of length 1, or its matrix no rotation",
    "are the numbers in the order that the format says, as w, x, y, z?",
)
_TOO_FAR = _Reason(
    f"it is more than {_FARTHEST_M:g} m from the origin", "are the positions in metres, in one frame of the world?"
)


@dataclass(frozen=True, eq=False)
class _LeftOut:
    """Rows (K of `total`) of one table that cannot be used, ascending, with the reason against each as a code.

    `class_names` are the classes that they have, and `described` yields what is listed of some of them, in portions.
    """

    table: str
    total: int
    rows: Ints
    codes: Ints
    reasons: Sequence[_Reason]
    class_names: Collection[str]
    described: Callable[[Ints, Sequence[str]], Iterator[RejectedRows]]

    def portions(self, chosen: slice | Ints = slice(None)) -> Iterator[RejectedRows]:
        """Yield what is listed of all of them, or of some."""
        texts = [self.reasons[code].text for code in self.codes[chosen].tolist()]
        yield from self.described(self.rows[chosen], texts)

    def counts(self) -> dict[str, int]:
        """Return how many there are by reason, in the order of the first of each."""
        found, first, count = np.unique(self.codes, return_index=True, return_counts=True)
        return {self.reasons[found[i]].text: int(count[i]) for i in np.argsort(first)}

    def refuse_too_many(self, source: str, max_share: float) -> None:
        """Raise `InputError` where they are too many of all."""
        what = {"detections": "boxes", "images": "images"}[self.table]
        counts = np.array([reason.counts for reason in self.reasons])
        faults = int(np.sum(counts[self.codes]))
        share = faults / max(self.total - len(self.rows) + faults, 1)  # What is no fault of the rows says nothing.
        if len(self.rows) < self.total and share <= max_share:
            return
        count = self.counts()
        no_fault = {reason.text for reason in self.reasons if not reason.counts}
        leading = sorted(count, key=lambda text: (text in no_fault, -count[text]))
        codes = [next(i for i, reason in enumerate(self.reasons) if reason.text == text) for text in leading]
        told = []
        for text, code in zip(leading[:_SHOWN_REASONS], codes, strict=False):
            first = next(self.portions(np.flatnonzero(self.codes == code)[:1]))
            told.append(f"{text} ({count[text]}, the first is {first.place[0].as_py()}{_found(first)})")
        everything = len(self.rows) == self.total
        limit = "none is left" if everything else f"more than {100.0 * max_share:g} %"
        way_round = "" if everything else f"; or leave them out with --max-rejected {np.ceil(share * 100.0) / 100.0:g}"
        raise InputError(
            f"{source}: {len(self.rows)} of {self.total} {what} cannot be used, {limit}: {'; '.join(told)}",
            hint=f"{self.reasons[codes[0]].hint}{way_round}",
        )


@dataclass(eq=False)
class Rejections:
    """Rows left out so far, in the order in which they were found to be unusable."""

    source: str
    max_share: float = MAX_REJECTED
    _parts: list[_LeftOut] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not 0.0 <= self.max_share <= 1.0:
            raise SettingError(
                f"max-rejected: expected a share from 0 to 1, found {self.max_share}",
                hint="for example 0.05 for one row in twenty",
            )

    def __len__(self) -> int:
        return sum(len(part.rows) for part in self._parts)

    def portions(self) -> Iterator[RejectedRows]:
        """Yield all of them in portions; all have the same categories."""
        tables = tuple(sorted({part.table for part in self._parts}))
        reasons = tuple(sorted({text for part in self._parts for text in part.counts()}))
        classes = tuple(sorted({text for part in self._parts for text in part.class_names}))
        for part in self._parts:
            for rows in part.portions():
                yield rows.replace(
                    table=_recoded(rows.table, tables),
                    reason=_recoded(rows.reason, reasons),
                    class_name=_recoded(rows.class_name, classes),
                )

    def counts(self) -> dict[str, dict[str, int]]:
        """Return how many rows were left out, by table and reason, the most frequent reason first."""
        counts: dict[str, dict[str, int]] = {}
        for part in self._parts:
            of_table = counts.setdefault(part.table, {})
            for text, count in part.counts().items():
                of_table[text] = of_table.get(text, 0) + count
        return {table: dict(sorted(by.items(), key=lambda item: (-item[1], item[0]))) for table, by in counts.items()}

    def add(self, part: _LeftOut, source: str | None = None) -> None:
        """Take rows, of another source where it is given; raise `InputError` where they are too many of all."""
        if len(part.rows):
            self._parts.append(part)
            part.refuse_too_many(source or self.source, self.max_share)

    def add_unreadable(self, reason_of: Mapping[str, str]) -> None:
        """Take pictures that cannot be read at all, by name."""
        if not reason_of:
            return
        names = list(reason_of)
        reasons = [_Reason(_text(text), "", counts=False) for text in sorted(set(reason_of.values()))]
        code_of = {reason.text: code for code, reason in enumerate(reasons)}

        def described(rows: Ints, texts: Sequence[str]) -> Iterator[RejectedRows]:
            of_row = [names[row] for row in rows.tolist()]
            yield _rejected_images(of_row, [f"{self.source}/{name}" for name in of_row], texts)

        codes = np.array([code_of[_text(reason_of[name])] for name in names], np.int64)
        self._parts.append(_LeftOut("images", len(names), np.arange(len(names)), codes, reasons, {""}, described))


def _rejected_images(names: Sequence[str], places: Sequence[str], reasons: Sequence[str]) -> RejectedRows:
    count = len(names)
    return RejectedRows(
        table=Categories.from_texts(["images"] * count),
        place=pa.array([_text(place) for place in places], pa.string()),
        reason=Categories.from_texts(reasons),
        image_name=pa.array([_text(name) for name in names], pa.string()),
        class_name=Categories.from_texts([""] * count),
        center_px=np.full((count, 2), np.nan),
        size_px=np.full((count, 2), np.nan),
        score=np.full(count, np.nan),
    )


def _rejected_boxes(boxes: FiledBoxes, rows: Ints, reasons: Sequence[str]) -> Iterator[RejectedRows]:
    """Yield what is listed of some boxes, ascending, in portions."""
    window = rows // row_file.PORTION
    for portion in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(window)) + 1):
        first, last = int(rows[portion[0]]), int(rows[portion[-1]])
        values = boxes.read(first, last - first + 1)[rows[portion] - first]
        yield RejectedRows(
            table=Categories.from_texts(["detections"] * len(portion)),
            place=pa.array([_text(boxes.where(row)) for row in rows[portion].tolist()], pa.string()),
            reason=Categories.from_texts([reasons[i] for i in portion.tolist()]),
            image_name=pa.array([_text(boxes.image_names[code]) for code in values["image"].tolist()], pa.string()),
            class_name=Categories.from_texts([_text(boxes.class_names[code]) for code in values["class"].tolist()]),
            center_px=_finite(values["center"]),
            size_px=_finite(values["size"]),
            score=_finite(values["score"]),
        )


class Verdicts:
    """For each row (N) of a portion the first reason that was found against it, as a code of `reasons`, or -1."""

    def __init__(self, count: int, reasons: list[_Reason] | None = None) -> None:
        self.code = np.full(count, -1, dtype=np.int32)
        self.reasons: list[_Reason] = [] if reasons is None else reasons

    def mark(self, wrong: Bools | np.bool_, reason: _Reason) -> None:
        """Note a reason against rows that have none yet."""
        if reason not in self.reasons:
            self.reasons.append(reason)
        self.code[wrong & (self.code < 0)] = self.reasons.index(reason)

    @property
    def fine(self) -> Bools:
        """The rows without a reason against them."""
        return self.code < 0


def vet_images(
    images: Images,
    rejections: Rejections,
    where: Callable[[int], str] | None = None,
    unposed: Mapping[int, str] | None = None,
) -> tuple[Images, Bools]:
    """Return the images that can be used and which rows (N) they are; the others go to the rejections.

    `unposed` says why rows have no pose where poses were to be found: they do not count toward the share of those
    rejected.
    """
    why = Verdicts(len(images))
    for reason in sorted(set((unposed or {}).values())):
        rows = [row for row, text in (unposed or {}).items() if text == reason]
        why.mark(
            np.isin(np.arange(len(images)), rows),
            _Reason(reason, "the page of the format in docs/formats says when images have poses", counts=False),
        )
    pose = np.hstack([images.cam_from_world_quat, images.cam_from_world_m])
    why.mark(~np.isfinite(pose).all(axis=1), _POSE_NOT_FINITE)
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(images.cam_from_world_quat, axis=1)
        why.mark(~(np.abs(length - 1.0) <= _QUATERNION_TOLERANCE), _NO_ROTATION)
        why.mark(~(np.linalg.norm(images.cam_from_world_m, axis=1) <= _FARTHEST_M), _TOO_FAR)

    def described(rows: Ints, texts: Sequence[str]) -> Iterator[RejectedRows]:
        names = [str(images.name[row].as_py()) for row in rows.tolist()]
        if where is None:
            places = [f"{rejections.source}: image {name!r}" for name in names]
        else:
            places = [where(row) for row in rows.tolist()]
        yield _rejected_images(names, places, texts)

    wrong = np.flatnonzero(why.code >= 0)
    codes = why.code[wrong].astype(np.int64)
    rejections.add(_LeftOut("images", len(images), wrong, codes, why.reasons, {""}, described))
    return (images if why.fine.all() else images.take(why.fine)), why.fine


def refuse_too_many_unreadable(
    reason_of: Mapping[str, str], total: int, max_share: float, source: str, hint: str
) -> None:
    """Raise `InputError` where too many of all pictures (`total`) cannot be used, by their names; `hint` helps."""
    if not reason_of or (len(reason_of) < total and len(reason_of) <= max_share * total):
        return
    shown = "; ".join(f"{name}: {_text(reason)}" for name, reason in list(reason_of.items())[:_SHOWN_REASONS])
    share = np.ceil(100.0 * len(reason_of) / total) / 100.0
    way_round = f"; or leave them out with --max-rejected {share:g}" if len(reason_of) < total else ""
    raise InputError(
        f"{source}: {len(reason_of)} of {total} pictures cannot be used: {shown}", hint=f"{hint}{way_round}"
    )


def vet_boxes(
    boxes: FiledBoxes,
    images: Images,
    usable: Bools,
    cameras: Cameras,
    rejections: Rejections,
    unreadable: Collection[str] = (),
    not_chosen: Callable[[Collection[str]], Collection[str]] | None = None,
) -> Callable[[], Iterator[Detections]]:
    """Return what yields the boxes that can be used, numbered and in portions; the others go to the rejections.

    Boxes are looked at in the order of the file, then by image, as one is there twice in one image only, and come out
    by their ids. What is between lies in temporary files.

    `images` are those that `image_row` counts, with all that were left out; `usable` (N) says which were not.
    `unreadable` are names of pictures that are not even among them. `not_chosen` says which names in the file are of
    images that the user chose not to read.
    """
    missing = {boxes.image_names[code] for code in np.flatnonzero(boxes.image_row < 0).tolist()}
    gone = match_images(missing, list(unreadable)) if unreadable else {}
    others = set() if not_chosen is None or not missing else set(not_chosen(missing - gone.keys()))
    known_not = [(_named(boxes, gone), _LEFT_OUT), (_named(boxes, others), _NOT_CHOSEN)]
    by_id = np.argsort(images.image_id, kind="stable")
    rank = np.empty(len(images), np.int64)
    rank[by_id] = np.arange(len(images))
    texts = [_text(text) for text in boxes.class_names]
    classes = tuple(sorted(set(texts)))
    code_of = {name: code for code, name in enumerate(classes)}
    class_code = np.array([code_of[text] for text in texts], np.int64)
    count = np.zeros(len(images), np.int64)
    for _, portion in boxes.rows.portions():
        np.add.at(count, rank[boxes.image_row[portion["image"]]], 1)
    has_ids, bounds_of_ids = are_distinct(boxes.rows) if boxes.has_ids else (False, bounds_by_count(count[:0]))
    more = (*(("detection_id",) if has_ids else ()), *boxes.optional())
    of_image = PartFile(structure(("row", *more)), bounds_by_count(count))
    left_out = _Noted(boxes, classes)
    judge = _Judge(
        images,
        usable,
        cameras,
        are_points=boxes.are_points,
        ranges=boxes.optional(),
        missing=missing - gone.keys() - others,
    )
    for first, portion in boxes.portions():
        of = boxes.image_row[portion["image"]]
        kind = class_code[portion["class"]]
        why = Verdicts(len(portion), left_out.reasons)
        for is_named, reason in known_not:
            why.mark(is_named[portion["image"]], reason)
        judge.mark(why, portion, of, kind == code_of.get("", -1))
        left_out.note(first + np.flatnonzero(~why.fine), why.code[~why.fine].astype(np.int64), kind[~why.fine])
        fine = np.empty(int(why.fine.sum()), of_image.dtype)
        for name in ("center", "size", "score", *more):
            fine[name] = portion[name][why.fine]
        fine["row"], fine["image"] = first + np.flatnonzero(why.fine), rank[of[why.fine]]
        fine["class"] = kind[why.fine]
        of_image.append(fine, fine["image"])
    by_number, in_order = PartFile(of_image.dtype, bounds_of_ids), RowFile(of_image.dtype)
    for part in of_image.parts():
        again = _repeated(part, has_ids=has_ids)
        left_out.note_repeated(part[again])
        part = part[~again]
        if has_ids:
            by_number.append(part, part["detection_id"])
        else:
            in_order.append(part[_order(*(part[name] for name in ("image", "class", "center", "size", "score")))])
    rejections.add(left_out.all(), boxes.source)

    def portions() -> Iterator[Detections]:
        for ids, part in _by_id(by_number) if has_ids else _counted(in_order):
            yield Detections(
                detection_id=ids,
                image_id=images.image_id[by_id[part["image"]]],
                class_name=Categories(part["class"].copy(), classes),
                **{f"{name}_px": part[name].copy() for name in ("center", "size")},
                **{name: part[name].copy() for name in ("score", *boxes.optional())},
            )

    return portions


def _named(boxes: FiledBoxes, names: Collection[str]) -> Bools:
    """Return which images in a file (M) have no row in the reader's table, and one of the names."""
    return np.array([name in names for name in boxes.image_names], np.bool_) & (boxes.image_row < 0)


def _by_id(file: PartFile) -> Iterator[tuple[Ints, Rows]]:
    """Yield the rows by their own ids."""
    for part in file.parts():
        part = part[np.argsort(part["detection_id"])]
        yield part["detection_id"].copy(), part


def _counted(file: RowFile) -> Iterator[tuple[Ints, Rows]]:
    """Yield the rows with numbers from 0."""
    for first, part in file.portions():
        yield np.arange(first, first + len(part)), part


class _Judge:
    """Looks at boxes by themselves, portion by portion."""

    def __init__(
        self,
        images: Images,
        usable: Bools,
        cameras: Cameras,
        *,
        are_points: bool,
        ranges: Sequence[str],
        missing: Collection[str],
    ) -> None:
        # Ids of cameras that are not there are found by the checks at the door.
        order = np.argsort(cameras.camera_id)
        place = np.searchsorted(cameras.camera_id[order], images.camera_id)
        self._camera_of_image = order[np.minimum(place, len(order) - 1)]
        self._picture_px = np.column_stack([cameras.width_px, cameras.height_px]).astype(np.float64)
        self._usable, self._are_points, self._ranges = usable, are_points, ranges
        names = images.name.to_pylist()
        hint = f"images are matched by file name, as in {names[0]!r}: correct the names"
        if (several := ambiguous(missing, names)) is not None:
            hint = (
                f"{several[0]!r} may be any of {len(several[1])} images, such as {several[1][0]!r} and "
                f"{several[1][1]!r}: give the folder too"
            )
        elif (alike := same_but_for_zeros(missing, names)) is not None:
            hint = (
                f"{alike[0]!r} would be {alike[1]!r} but for zeros: has a spreadsheet taken names for numbers? Keep "
                "that column as text"
            )
        self._no_image = _Reason("its image is not among the images with a pose", hint)

    def mark(self, why: Verdicts, portion: Rows, image_row: Ints, has_no_class: Bools) -> None:
        """Note what is wrong with each box."""
        center, size, score = portion["center"], portion["size"], portion["score"]
        if "entry" in (portion.dtype.names or ()):
            for entry, reason in _OF_ENTRY.items():
                if (portion["entry"] == entry).any():
                    why.mark(portion["entry"] == entry, reason)
        why.mark(image_row < 0, self._no_image)
        why.mark((image_row >= 0) & ~self._usable[image_row], _LEFT_OUT)
        why.mark(~np.isfinite(np.column_stack([center, size, score])).all(axis=1), _NOT_FINITE)
        if not self._are_points:
            why.mark(~(size > 0.0).all(axis=1), _NO_SIZE)
        picture = self._picture_px[self._camera_of_image[image_row]]
        why.mark((size > _MAX_SIZE_OF_PICTURE * picture).any(axis=1), _TOO_LARGE)
        why.mark(((center < 0.0) | (center > picture)).any(axis=1), _OUTSIDE)
        why.mark((score < 0.0) | (score > 1.0), _SCORE)
        for name in self._ranges:
            why.mark((portion[name] <= 0.0) | np.isinf(portion[name]), _RANGE)
        why.mark(has_no_class, _NO_CLASS)


class _Noted:
    """Which boxes are left out, as it is found out."""

    def __init__(self, boxes: FiledBoxes, classes: Sequence[str]) -> None:
        self.reasons: list[_Reason] = []
        self._boxes, self._classes = boxes, classes
        self._rows: list[Ints] = [np.empty(0, np.int64)]
        self._codes: list[Ints] = [np.empty(0, np.int64)]
        self._kinds: set[int] = set()

    def note(self, rows: Ints, codes: Ints, kinds: Ints) -> None:
        """Note the reasons (N) against boxes of these classes, by their codes."""
        self._rows.append(rows)
        self._codes.append(codes)
        self._kinds.update(np.unique(kinds).tolist())

    def note_repeated(self, part: Rows) -> None:
        """Note boxes that are there already."""
        if _TWICE not in self.reasons:
            self.reasons.append(_TWICE)
        self.note(part["row"], np.full(len(part), self.reasons.index(_TWICE)), part["class"])

    def all(self) -> _LeftOut:
        """Return all of them."""
        rows, codes = np.concatenate(self._rows), np.concatenate(self._codes)
        order = np.argsort(rows)
        names = {self._classes[kind] for kind in self._kinds}
        described = functools.partial(_rejected_boxes, self._boxes)
        return _LeftOut("detections", len(self._boxes), rows[order], codes[order], self.reasons, names, described)


def _repeated(boxes: Rows, *, has_ids: bool) -> Bools:
    """Return which boxes (N) another one repeats that has the same image, class, place and size.

    The one with the highest score stays, of these the one with the lowest id or that stands first.
    """
    result = np.zeros(len(boxes), dtype=np.bool_)
    same = (boxes["image"], boxes["class"], *boxes["center"].T, *boxes["size"].T)
    # Most boxes have no twin: a hash finds those that may have one, which alone are then sorted by all columns.
    mixed = np.zeros(len(boxes), dtype=np.uint64)
    for column in same:
        values = np.ascontiguousarray(column, np.float64) + 0.0  # -0 becomes 0, which it equals.
        mixed = (mixed ^ values.view(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    ascending = np.sort(mixed)
    maybe = np.flatnonzero(np.isin(mixed, ascending[1:][ascending[1:] == ascending[:-1]]))
    tie = boxes["detection_id" if has_ids else "row"][maybe]
    maybe = maybe[np.lexsort((tie, -boxes["score"][maybe], *(column[maybe] for column in same)))]
    is_repeat = np.ones(max(len(maybe) - 1, 0), dtype=np.bool_)
    for column in same:
        is_repeat &= column[maybe[1:]] == column[maybe[:-1]]
    result[maybe[1:][is_repeat]] = True
    return result


def number_detections(
    image_id: Ints, class_names: Sequence[str], center_px: Floats, size_px: Floats, score: Floats
) -> Detections:
    """Return boxes (N) that can all be used as detections; `image_id` is of `Images`, the rest as in `FoundBoxes`."""
    classes = Categories.from_texts(class_names)
    order = _order(image_id, classes.codes, center_px, size_px, score)
    ids = np.arange(len(order), dtype=np.int64)
    return Detections(ids, image_id[order], classes.take(order), center_px[order], size_px[order], score[order])


def _order(image: Ints, kind: NDArray[np.int32], center_px: Floats, size_px: Floats, score: Floats) -> Ints:
    """Return the order by which boxes are numbered that have no ids."""
    return np.lexsort((score, kind, *size_px.T, *center_px.T, image))


def _recoded(column: Categories, names: tuple[str, ...]) -> Categories:
    """Return the same texts as categories of more names."""
    code = np.array([names.index(name) for name in column.names], np.int32)
    return Categories(code[column.codes] if len(column) else column.codes, names)


def _text(text: str) -> str:
    """Return a text that can be written as UTF-8: what cannot, as of a name in another encoding, is escaped."""
    return text.encode("utf-8", "backslashreplace").decode()


def _finite(values: Floats) -> Floats:
    return np.where(np.isfinite(values), values, np.nan)


def _found(row: RejectedRows) -> str:
    """Return what a box was, where the file said it."""
    if row.table.texts()[0] != "detections":
        return ""
    x, y = row.center_px[0]
    width, height = row.size_px[0]
    image = row.image_name[0].as_py()
    return f": {image!r}, centre {x:g} {y:g}, size {width:g} x {height:g}, score {row.score[0]:g}"
