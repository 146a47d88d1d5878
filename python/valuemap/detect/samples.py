"""From labelled pictures to what the network trains on and is validated on."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Floats, Ints
from valuemap.config import TrainConfig
from valuemap.detect.augment import choose_window, vary_colours
from valuemap.detect.labels import LabelledPicture, LabelledPictures
from valuemap.detect.letterbox import Fit, fit_around
from valuemap.detect.masks import masks_of_boxes
from valuemap.detect.pictures import UnusablePicture, read_picture
from valuemap.errors import InputError
from valuemap.progress import Progress, counted

MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
"""Of RGB 0..1; the usual ones, and written into every model."""

MULTIPLE_PX = 32
"""Sides of what goes into a network are multiples of this."""

_MIN_FOLDERS = 5
_THREADS = 2

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Sample:
    """One picture or cut-out: (3, H, W) normalised, targets and weights (classes, H, W)."""

    image: Array
    target: Array
    weight: Array


@dataclass(frozen=True, eq=False)
class TrainingData:
    """The pictures by use, the names of the classes in the order of the network's outputs, and what was left out."""

    training: tuple[LabelledPicture, ...]
    validation: tuple[LabelledPicture, ...]
    classes: tuple[str, ...]
    skipped: tuple[str, ...]
    test_pictures: int

    def codes(self, picture: LabelledPicture) -> Ints:
        """Return the index of the class of each box."""
        return np.array([self.classes.index(name) for name in picture.classes], dtype=np.int64)

    def digest(self) -> str:
        """Return a text that changes with any picture's name, box, class or use."""
        sha = hashlib.sha256(repr(self.classes).encode())
        for use in (self.training, self.validation):
            for picture in use:
                sha.update(f"{picture.path.name} {picture.classes}".encode())
                sha.update(picture.boxes_px.tobytes() + picture.ignored_px.tobytes())
            sha.update(b"|")
        return sha.hexdigest()


def prepare_data(
    sources: Sequence[LabelledPictures], config: TrainConfig, *, one_class: str | None, seed: int, progress: Progress
) -> TrainingData:
    """Look through all pictures, leave out the broken ones, and part them into training and validation.

    Raises
    ------
    InputError
        There are too few pictures, or no boxes.
    """
    skipped = [line for source in sources for line in source.skipped]
    pictures = [picture for source in sources for picture in source.pictures]
    if one_class is not None:
        pictures = [replace(picture, classes=(one_class,) * len(picture.classes)) for picture in pictures]
    usable = _without_broken([p for p in pictures if p.split != "test"], skipped, progress)
    training, validation = _part(usable, config, seed)
    where = ", ".join(source.source for source in sources)
    left_out = f" ({len(skipped)} entries skipped, the first: {skipped[0]})" if skipped else ""
    if not usable:
        raise InputError(f"{where}: no usable pictures{left_out}", hint="are the pictures where the labels say?")
    if not training or not validation:
        raise InputError(
            f"{where}: {len(training)} usable pictures for training, {len(validation)} for validation{left_out}",
            hint="at least one is needed for each: add pictures, or raise validation_share",
        )
    classes = tuple(sorted({name for picture in training for name in picture.classes}))
    if not classes:
        raise InputError(f"{where}: no picture for training has a box{left_out}", hint="label some objects")
    unknown = {name for picture in validation for name in picture.classes} - set(classes)
    if unknown:
        raise InputError(
            f"{where}: class {min(unknown)!r} is in the pictures for validation only",
            hint="take all classes as one with --class, or move a picture that has it into training",
        )
    test_pictures = sum(picture.split == "test" for picture in pictures)
    return TrainingData(tuple(training), tuple(validation), classes, tuple(skipped), test_pictures)


def cut_out(data: TrainingData, row: int, config: TrainConfig, rng: np.random.Generator) -> Sample:
    """Return a cut-out, chosen and varied at random, of a picture for training."""
    picture = data.training[row]
    pixels = read_picture(picture.path).pixels
    size_px = (pixels.shape[1], pixels.shape[0])
    window = choose_window(size_px, picture.boxes_px, config, rng)
    target, weight = masks_of_boxes(
        window.edges(picture.boxes_px),
        data.codes(picture),
        window.edges(picture.ignored_px),
        classes=len(data.classes),
        size_px=(config.crop_px, config.crop_px),
        small_object_px=config.small_object_px,
    )
    return Sample(normalise(vary_colours(window.draw(pixels), config, rng)), target.astype(np.float32), weight)


def whole(data: TrainingData, row: int, config: TrainConfig) -> tuple[Sample, Fit]:
    """Return a whole picture for validation; its padding has no weight."""
    picture = data.validation[row]
    pixels = read_picture(picture.path).pixels
    fit = fit_around((pixels.shape[1], pixels.shape[0]), MULTIPLE_PX)
    target, weight = masks_of_boxes(
        edges_of(picture.boxes_px),
        data.codes(picture),
        edges_of(picture.ignored_px),
        classes=len(data.classes),
        size_px=fit.canvas,
        small_object_px=config.small_object_px,
    )
    weight[:, fit.resized[1] :] = 0.0
    weight[:, :, fit.resized[0] :] = 0.0
    image = normalise(fit.draw(pixels).astype(np.float32) / np.float32(255.0))
    return Sample(image, target.astype(np.float32), weight), fit


def batches(data: TrainingData, config: TrainConfig, *, seed: int, epoch: int) -> Iterator[tuple[Array, Array, Array]]:
    """Yield images, targets and weights of one epoch; the same for the same seed and epoch, and made ahead."""
    order = np.random.default_rng([seed, epoch]).permutation(len(data.training) * config.cutouts)
    groups = [order[start : start + config.batch] for start in range(0, len(order), config.batch)]

    def make(numbers: Ints) -> tuple[Array, Array, Array]:
        made = [
            cut_out(data, number % len(data.training), config, np.random.default_rng([seed, epoch, number]))
            for number in numbers.tolist()
        ]
        return (
            np.stack([sample.image for sample in made]),
            np.stack([sample.target for sample in made]),
            np.stack([sample.weight for sample in made]),
        )

    with ThreadPoolExecutor(_THREADS) as pool:
        waiting = [pool.submit(make, numbers) for numbers in groups[: 2 * _THREADS]]
        for number in range(len(groups)):
            yield waiting.pop(0).result()
            following = number + 2 * _THREADS
            if following < len(groups):
                waiting.append(pool.submit(make, groups[following]))


def normalise(picture: NDArray[Any]) -> Array:
    """Return RGB 0..1 (H, W, 3) as the network takes it (3, H, W)."""
    normal = (picture - np.array(MEAN, np.float32)) / np.array(STD, np.float32)
    return np.ascontiguousarray(normal.transpose(2, 0, 1), np.float32)


def edges_of(boxes_px: Floats) -> Floats:
    """Return left, top, right, bottom of boxes of centre and size."""
    half = boxes_px[:, 2:] / 2.0
    return np.hstack([boxes_px[:, :2] - half, boxes_px[:, :2] + half])


def _without_broken(pictures: list[LabelledPicture], skipped: list[str], progress: Progress) -> list[LabelledPicture]:
    """Decode every picture once, so that training never meets a broken one."""

    def reason(picture: LabelledPicture) -> str | None:
        try:
            read_picture(picture.path)
        except UnusablePicture as error:
            return f"{picture.path}: {error}"
        return None

    usable: list[LabelledPicture] = []
    what = "look through the pictures"
    with ThreadPoolExecutor(_THREADS) as pool, counted(progress, what, len(pictures)) as tell:
        for done, (picture, why) in enumerate(zip(pictures, pool.map(reason, pictures), strict=True), start=1):
            if why is None:
                usable.append(picture)
            else:
                skipped.append(why)
            tell(done)
    return usable


def _part(
    pictures: list[LabelledPicture], config: TrainConfig, seed: int
) -> tuple[list[LabelledPicture], list[LabelledPicture]]:
    """Part into training and validation as the labels say; else whole folders, where there are enough."""
    training = [picture for picture in pictures if picture.split == "train"]
    validation = [picture for picture in pictures if picture.split == "val"]
    free = [picture for picture in pictures if not picture.split]
    if not validation and not free:
        training, free = [], training
    # Neighbouring pictures of one drive are nearly the same: those of one folder stay together.
    names = [str(picture.path.parent) for picture in free]
    if len(set(names)) < _MIN_FOLDERS:
        names = [str(row) for row in range(len(free))]
    order = sorted(set(names), key=lambda name: names.index(name))
    shuffled = np.random.default_rng([seed, len(order)]).permutation(len(order))
    wanted, chosen = config.validation_share * len(free), set[str]()
    for place in shuffled[:-1]:  # Something is left for training, whatever the share.
        if sum(name in chosen for name in names) < wanted:
            chosen.add(order[place])
    for name, picture in zip(names, free, strict=True):
        (validation if name in chosen else training).append(picture)
    return training, validation
