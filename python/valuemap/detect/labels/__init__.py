"""Labelled pictures from disk: `read_labels("bosch:FILE" | "yolo:DIR" | "coco:FILE")`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from valuemap.detect.labels.bosch import read_bosch
from valuemap.detect.labels.coco import read_coco
from valuemap.detect.labels.pictures import LabelledPicture, LabelledPictures
from valuemap.detect.labels.yolo import read_yolo
from valuemap.errors import InputError

__all__ = ["LOADERS", "LabelledPicture", "LabelledPictures", "read_labels"]

LOADERS: dict[str, Callable[[Path], LabelledPictures]] = {"bosch": read_bosch, "coco": read_coco, "yolo": read_yolo}


def read_labels(spec: str) -> LabelledPictures:
    """Read the labels that `spec` names: `bosch:FILE`, `yolo:DIR` or `coco:FILE`.

    A broken label is noted in `skipped` and left out; so is a picture whose size is needed and cannot be read.

    Raises
    ------
    InputError
        The format is unknown, the file or folder is not there or is none of that format, or nothing in it is
        usable.
    """
    name, colon, place = spec.partition(":")
    if not colon or name not in LOADERS or not place:
        raise InputError(
            f"labels {spec!r}: expected a format and a place, the format one of {', '.join(sorted(LOADERS))}",
            hint="for example bosch:train.yaml, yolo:pictures or coco:annotations.json",
        )
    labels = LOADERS[name](Path(place))
    if not labels.pictures:
        first = f": {labels.skipped[0]}" if labels.skipped else ""
        raise InputError(
            f"{spec}: no usable picture ({len(labels.skipped)} entries skipped{first})",
            hint="check that it is the right format and the right place",
        )
    return labels
