"""Which of the boxes and images that a reader found can be used: the rest is left out, listed and counted, not lost."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa

from valuemap.errors import InputError, SettingError
from valuemap.readers.texts import Texts
from valuemap.tables import Bools, Cameras, Categories, Detections, Floats, Images, Ints, RejectedRows

MAX_REJECTED = 0.01
"""An import stops where a larger share of the boxes, or of the images, cannot be used."""

_QUATERNION_TOLERANCE = 1e-3
_MAX_SIZE_OF_PICTURE = 2.0
_SHOWN_REASONS = 3
_PORTION = 500_000
"""Boxes that are looked at together."""


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
# What goes with its image is the image's fault, which was counted.
_LEFT_OUT = _Reason("its image was left out", "repair the image first", counts=False)
_POSE_NOT_FINITE = _Reason("a number of its pose is missing or not finite", "repair the poses of these images")
_NO_ROTATION = _Reason(
    "its quaternion is not of length 1", "quaternions are w, x, y, z and rotate the world into the camera"
)


@dataclass(frozen=True, eq=False)
class FoundBoxes:
    """Boxes as a reader found them, in any order, checked by nobody yet.

    Parameters
    ----------
    image_row
        Row (N) of each box's image in the reader's table of images; -1 where it is not among them.
    class_names, score
        One a box (N); an empty text for a class, and NaN for a score, that the file does not have.
    center_px, size_px
        Centre and size (N, 2) in pixels, centre of the top-left pixel at (0.5, 0.5); NaN for what is no number.
    where
        Returns the place of a box in the user's files, for its index here.
    image_names
        The names (N) that the file has for the images; needed where some `image_row` is -1.
    detection_id
        Distinct ids (N). Without them the boxes are numbered from 0 by image, place, size, class and score,
        so that the numbers do not depend on the order of the boxes.
    range_m, range_sigma_m
        Measured distances (N) in metres, NaN where there is none.
    vertical_sigma_px
        Standard deviations (N) of the centre's y, NaN where it is that of its x.
    are_points
        The boxes are directions without a size, so that a size of 0 is right.
    """

    image_row: Ints
    class_names: Sequence[str]
    center_px: Floats
    size_px: Floats
    score: Floats
    where: Callable[[int], str]
    image_names: Sequence[str] | None = None
    detection_id: Ints | None = None
    range_m: Floats | None = None
    range_sigma_m: Floats | None = None
    vertical_sigma_px: Floats | None = None
    are_points: bool = False

    @staticmethod
    def none() -> FoundBoxes:
        """Return no boxes: they are still to be found in the pictures."""
        nothing = np.empty(0)
        pairs = np.empty((0, 2))
        return FoundBoxes(nothing.astype(np.int64), [], pairs, pairs, nothing, str)

    def __len__(self) -> int:
        return len(self.image_row)


@dataclass(eq=False)
class Rejections:
    """Rows left out so far, in the order in which they were found to be unusable."""

    source: str
    max_share: float = MAX_REJECTED
    _parts: list[RejectedRows] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not 0.0 <= self.max_share <= 1.0:
            raise SettingError(
                f"max-rejected: expected a share from 0 to 1, found {self.max_share}",
                hint="for example 0.05 for one row in twenty",
            )

    def table(self) -> RejectedRows | None:
        """Return all of them, or None where there are none."""
        if not any(map(len, self._parts)):
            return None

        def together(name: str) -> Categories:
            return Categories.from_texts([text for part in self._parts for text in getattr(part, name).texts()])

        return RejectedRows(
            table=together("table"),
            place=pa.concat_arrays([part.place for part in self._parts]),
            reason=together("reason"),
            image_name=pa.concat_arrays([part.image_name for part in self._parts]),
            class_name=together("class_name"),
            center_px=np.concatenate([part.center_px for part in self._parts]),
            size_px=np.concatenate([part.size_px for part in self._parts]),
            score=np.concatenate([part.score for part in self._parts]),
        )

    def add(
        self,
        table: str,
        why: Verdicts,
        *,
        where: Callable[[int], str],
        image_names: Callable[[int], str],
        boxes: FoundBoxes | None = None,
    ) -> None:
        """Take the rows of `why` that have a reason; raise `InputError` where they are too many of all."""
        rows = np.flatnonzero(why.code >= 0)
        if not len(rows):
            return
        nothing = np.full(len(rows), np.nan)
        pairs = np.full((len(rows), 2), np.nan)
        part = RejectedRows(
            table=Categories.from_texts([table] * len(rows)),
            place=pa.array([_text(where(row)) for row in rows.tolist()], pa.string()),
            reason=Categories.from_texts([why.reasons[code].text for code in why.code[rows].tolist()]),
            image_name=pa.array([_text(image_names(row)) for row in rows.tolist()], pa.string()),
            class_name=Categories.from_texts([_text(boxes.class_names[row]) if boxes else "" for row in rows.tolist()]),
            center_px=pairs if boxes is None else _finite(boxes.center_px[rows]),
            size_px=pairs if boxes is None else _finite(boxes.size_px[rows]),
            score=nothing if boxes is None else _finite(boxes.score[rows]),
        )
        self._parts.append(part)
        self._refuse_too_many(table, why, part)

    def add_unreadable(self, reason_of: Mapping[str, str]) -> None:
        """Take pictures that cannot be read at all, by name."""
        count = len(reason_of)
        if count:
            nothing = Categories.from_texts([""] * count)
            self._parts.append(
                RejectedRows(
                    table=Categories.from_texts(["images"] * count),
                    place=pa.array([_text(f"{self.source}/{name}") for name in reason_of], pa.string()),
                    reason=Categories.from_texts([_text(reason) for reason in reason_of.values()]),
                    image_name=pa.array([_text(name) for name in reason_of], pa.string()),
                    class_name=nothing,
                    center_px=np.full((count, 2), np.nan),
                    size_px=np.full((count, 2), np.nan),
                    score=np.full(count, np.nan),
                )
            )

    def _refuse_too_many(self, table: str, why: Verdicts, part: RejectedRows) -> None:
        what = {"detections": "boxes", "images": "images"}[table]
        counted = [code for code in why.code.tolist() if code >= 0 and why.reasons[code].counts]
        share = len(counted) / len(why.code)
        if len(part) < len(why.code) and share <= self.max_share:
            return
        reason_of = part.reason.texts()
        count = {reason: sum(text == reason for text in reason_of) for reason in dict.fromkeys(reason_of)}
        leading = sorted(count, key=lambda reason: -count[reason])
        told = [
            f"{reason} ({count[reason]}, the first is {part.place[reason_of.index(reason)].as_py()}"
            f"{_found(part, reason_of.index(reason))})"
            for reason in leading[:_SHOWN_REASONS]
        ]
        everything = len(part) == len(why.code)
        limit = "none is left" if everything else f"more than {100.0 * self.max_share:g} %"
        way_round = "" if everything else f"; or leave them out with --max-rejected {np.ceil(share * 100.0) / 100.0:g}"
        hint = next(reason.hint for reason in why.reasons if reason.text == leading[0])
        raise InputError(
            f"{self.source}: {len(part)} of {len(why.code)} {what} cannot be used, {limit}: {'; '.join(told)}",
            hint=f"{hint}{way_round}",
        )


class Verdicts:
    """For each row (N) the first reason that was found against it, as a code, or -1."""

    def __init__(self, count: int) -> None:
        self.code = np.full(count, -1, dtype=np.int32)
        self.reasons: list[_Reason] = []

    def mark(self, wrong: Bools | np.bool_, reason: _Reason, part: slice = slice(None)) -> None:
        """Note a reason against rows, or a part of them, that have none yet."""
        if reason not in self.reasons:
            self.reasons.append(reason)
        code = self.code[part]
        code[wrong & (code < 0)] = self.reasons.index(reason)

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
        why.mark(np.isin(np.arange(len(images)), rows), _Reason(reason, "see docs/formats/pictures.md", counts=False))
    pose = np.hstack([images.cam_from_world_quat, images.cam_from_world_m])
    why.mark(~np.isfinite(pose).all(axis=1), _POSE_NOT_FINITE)
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(images.cam_from_world_quat, axis=1)
        why.mark(~(np.abs(length - 1.0) <= _QUATERNION_TOLERANCE), _NO_ROTATION)

    def name(row: int) -> str:
        return str(images.name[row].as_py())

    rejections.add(
        "images",
        why,
        where=where or (lambda row: f"{rejections.source}: image {name(row)!r}"),
        image_names=name,
    )
    return (images if why.fine.all() else images.take(why.fine)), why.fine


def vet_boxes(boxes: FoundBoxes, images: Images, usable: Bools, cameras: Cameras, rejections: Rejections) -> Detections:
    """Return the boxes that can be used, numbered; the others go to the rejections.

    `images` are those that `image_row` counts, with all that were left out; `usable` (N) says which were not.
    """
    classes = Texts.of(boxes.class_names).categories(_text)
    why = Verdicts(len(boxes))
    row = np.asarray(boxes.image_row, np.int64)
    # Ids of cameras that are not there are found by the checks at the door.
    order = np.argsort(cameras.camera_id)
    place = np.searchsorted(cameras.camera_id[order], images.camera_id)
    camera_of_image = order[np.minimum(place, len(order) - 1)]
    picture_px = np.column_stack([cameras.width_px, cameras.height_px]).astype(np.float64)
    ranges = [values for values in (boxes.range_m, boxes.range_sigma_m, boxes.vertical_sigma_px) if values is not None]
    no_image = _Reason(
        "its image is not among the images with a pose",
        f"images are matched by file name, as in {str(images.name[0].as_py())!r}: correct the names",
    )
    # In portions: what is between takes more memory than the boxes.
    for start in range(0, len(boxes), _PORTION):
        part = slice(start, start + _PORTION)
        of, center, size, score = row[part], boxes.center_px[part], boxes.size_px[part], boxes.score[part]
        why.mark(of < 0, no_image, part)
        why.mark((of >= 0) & ~usable[of], _LEFT_OUT, part)
        why.mark(~np.isfinite(np.column_stack([center, size, score])).all(axis=1), _NOT_FINITE, part)
        if not boxes.are_points:
            why.mark(~(size > 0.0).all(axis=1), _NO_SIZE, part)
        picture = picture_px[camera_of_image[of]]
        why.mark((size > _MAX_SIZE_OF_PICTURE * picture).any(axis=1), _TOO_LARGE, part)
        why.mark(((center < 0.0) | (center > picture)).any(axis=1), _OUTSIDE, part)
        why.mark((score < 0.0) | (score > 1.0), _SCORE, part)
        for values in ranges:
            why.mark((values[part] <= 0.0) | np.isinf(values[part]), _RANGE, part)
        why.mark(classes.codes[part] == classes.code_of(""), _NO_CLASS, part)
    why.mark(_repeated(boxes, classes, why.fine), _TWICE)

    def image_name(i: int) -> str:
        if boxes.image_names is not None:
            return boxes.image_names[i]
        return str(images.name[row[i]].as_py()) if row[i] >= 0 else ""

    rejections.add("detections", why, where=boxes.where, image_names=image_name, boxes=boxes)
    fine = slice(None) if why.fine.all() else why.fine  # A slice takes no memory.
    return number_detections(
        images.image_id[row[fine]],
        Categories(classes.codes[fine], classes.names),
        boxes.center_px[fine],
        boxes.size_px[fine],
        boxes.score[fine],
        None if boxes.detection_id is None else boxes.detection_id[fine],
        None if boxes.range_m is None else boxes.range_m[fine],
        None if boxes.range_sigma_m is None else boxes.range_sigma_m[fine],
        None if boxes.vertical_sigma_px is None else boxes.vertical_sigma_px[fine],
    )


def number_detections(
    image_id: Ints,
    class_names: Sequence[str] | Categories,
    center_px: Floats,
    size_px: Floats,
    score: Floats,
    detection_id: Ints | None = None,
    range_m: Floats | None = None,
    range_sigma_m: Floats | None = None,
    vertical_sigma_px: Floats | None = None,
) -> Detections:
    """Return boxes that can all be used as detections; `image_id` (N) is of `Images`, the rest as in `FoundBoxes`."""
    classes = class_names if isinstance(class_names, Categories) else Categories.from_texts(class_names)
    if detection_id is None:
        order = np.lexsort((score, classes.codes, *size_px.T, *center_px.T, image_id))
        ids: Ints = np.arange(len(order), dtype=np.int64)
    else:
        order = np.argsort(detection_id)
        ids = detection_id[order]
    return Detections(
        detection_id=ids,
        image_id=image_id[order],
        class_name=classes.take(order),
        center_px=center_px[order],
        size_px=size_px[order],
        score=score[order],
        range_m=None if range_m is None else range_m[order],
        range_sigma_m=None if range_sigma_m is None else range_sigma_m[order],
        vertical_sigma_px=None if vertical_sigma_px is None else vertical_sigma_px[order],
    )


def _repeated(boxes: FoundBoxes, classes: Categories, fine: Bools) -> Bools:
    """Return which boxes (N) another one repeats that has the same image, class, place and size.

    The one with the highest score stays, of these the one with the lowest id or that stands first.
    """
    result = np.zeros(len(boxes), dtype=np.bool_)
    rows = np.flatnonzero(fine)
    same = (boxes.image_row, classes.codes, *boxes.center_px.T, *boxes.size_px.T)
    # Most boxes have no twin: a hash finds those that may have one, which alone are then sorted by all columns.
    mixed = np.zeros(len(boxes), dtype=np.uint64)
    for start in range(0, len(boxes), _PORTION):
        part = mixed[start : start + _PORTION]
        for column in same:
            values = column[start : start + _PORTION] + 0.0  # -0 becomes 0, which it equals.
            part[:] = (part ^ values.view(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
            part ^= part >> np.uint64(29)
    mixed = mixed[rows]
    ascending = np.sort(mixed)
    maybe = rows[np.isin(mixed, ascending[1:][ascending[1:] == ascending[:-1]])]
    tie = maybe if boxes.detection_id is None else boxes.detection_id[maybe]
    maybe = maybe[np.lexsort((tie, -boxes.score[maybe], *(column[maybe] for column in same)))]
    is_repeat = np.ones(max(len(maybe) - 1, 0), dtype=np.bool_)
    for column in same:
        is_repeat &= column[maybe[1:]] == column[maybe[:-1]]
    result[maybe[1:][is_repeat]] = True
    return result


def _text(text: str) -> str:
    """Return a text that can be written as UTF-8: what cannot, as of a name in another encoding, is escaped."""
    return text.encode("utf-8", "backslashreplace").decode()


def _finite(values: Floats) -> Floats:
    return np.where(np.isfinite(values), values, np.nan)


def _found(part: RejectedRows, row: int) -> str:
    """Return what a box was, where the file said it."""
    if part.table.texts()[row] != "detections":
        return ""
    x, y = part.center_px[row]
    width, height = part.size_px[row]
    image = part.image_name[row].as_py()
    return f": {image!r}, centre {x:g} {y:g}, size {width:g} x {height:g}, score {part.score[row]:g}"


def count_reasons(rejected: RejectedRows) -> dict[str, dict[str, int]]:
    """Return how many rows were left out, by table and reason, the most frequent reason first."""
    counts: dict[str, dict[str, int]] = {}
    for table, reason in zip(rejected.table.texts(), rejected.reason.texts(), strict=True):
        of_table = counts.setdefault(table, {})
        of_table[reason] = of_table.get(reason, 0) + 1
    return {table: dict(sorted(by.items(), key=lambda item: (-item[1], item[0]))) for table, by in counts.items()}
