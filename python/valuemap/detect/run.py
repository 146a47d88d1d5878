"""Whole runs: the pictures of a dataset or of a folder through a detector, with a record; interrupted ones go on."""

from __future__ import annotations

import hashlib
import json
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.config import DetectConfig
from valuemap.dataset import read_images, rows_of
from valuemap.detect.boxes import Boxes
from valuemap.detect.infer import Detector, Task
from valuemap.detect.journal import Journal, Outcome
from valuemap.detect.panorama import MODEL as PANORAMA
from valuemap.detect.pictures import list_pictures
from valuemap.detect.shards import detect_in_shards
from valuemap.detect.truth import find_truth_detections
from valuemap.engine.engine import Engine
from valuemap.errors import InputError, OutputError
from valuemap.folders import check_files, new_file, remove_file
from valuemap.progress import Progress, counted, silent
from valuemap.remote import UrlPath, place_of
from valuemap.tables import Cameras, Categories, Detections, Images, Truth
from valuemap.tables.read import read_table
from valuemap.tables.write import write_table

RECORD = "detect.json"
"""The record of a run. It is not called run.json, as that file makes a folder a map."""
RESULTS = "detections.json"
"""What a run over a folder of pictures finds, in COCO's format."""
_JOURNAL = ".detect.journal"
_DETECTIONS, _TRUTH_DETECTIONS = "detections.parquet", "truth_detections.parquet"


@dataclass(frozen=True, eq=False)
class PictureBoxes:
    """Boxes of one picture, in its pixels as stored, with class names; `problem` says why there are none."""

    path: Path
    stored_px: tuple[int, int]
    boxes: Boxes
    class_names: tuple[str, ...]
    problem: str | None


def detect_dataset(
    dataset: str | Path,
    model: str | Path,
    config: DetectConfig | None = None,
    *,
    pictures: str | Path | None = None,
    engine: Engine | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> Detections:
    """Look for objects in the pictures of a dataset, and make what is found its detections.

    `detections.parquet` is replaced when all pictures are done, and `detect.json` says how it came about: model,
    settings, counts, speed, and the pictures that could not be used. A run that was interrupted goes on where it
    stopped if it is started again with the same model and settings, and finds the same to the last bit. Where the
    dataset has truth, `truth_detections.parquet` is made anew, by where the objects are in the pictures.

    Parameters
    ----------
    dataset
        Folder of a dataset; it needs no detections yet.
    model
        ONNX file; see `valuemap.detect.model` for what it may be.
    config
        Settings; the defaults where not given.
    pictures
        Folder, or URL as a text, in which the names of the images are; default: `images` in the dataset.
    engine
        Where the pictures are looked at; default: in this process. The detections are the same, and an interrupted run
        may go on with another one.
    force
        Replace detections that valuemap did not write, too.
    progress
        Called as progress("pictures", done, total).

    Raises
    ------
    InputError
        The dataset or the model cannot be used, or none of the pictures.
    SettingError
        A class that the model does not have, or a provider that is not installed.
    ClusterError
        As the engine.
    OutputError
        The dataset has detections that valuemap did not write, or cannot be written.
    """
    folder, config = Path(dataset), config or DetectConfig()
    cameras, images = read_images(folder)
    check_files(folder, (_DETECTIONS, _TRUTH_DETECTIONS, RECORD), force=force)
    place = place_of(pictures) if pictures is not None else folder / "images"
    if not place.is_dir():
        raise InputError(f"{place}: no such folder of pictures", hint="say where the pictures are with --images")
    names = images.name.to_pylist()
    with _Run(Path(model), config, folder, _tasks_of(place, names, cameras, images), names, engine) as run:
        run.finish(progress)
        detections = _as_detections(run.detector, run.journal, images)
        # The old pairs go first: at no time do they stand beside detections that they are not of.
        remove_file(folder / _TRUTH_DETECTIONS, force=force)
        with new_file(folder / _DETECTIONS, force=force) as path:
            write_table(detections, path)
        if (folder / "truth.parquet").is_file():
            truth = read_table(Truth, folder / "truth.parquet")
            with new_file(folder / _TRUTH_DETECTIONS, force=force) as path:
                write_table(find_truth_detections(cameras, images, detections, truth), path)
        run.write_record(force=force)
    return detections


def detect_folder(
    pictures: str | Path,
    model: str | Path,
    config: DetectConfig | None = None,
    *,
    out: str | Path | None = None,
    engine: Engine | None = None,
    force: bool = False,
    progress: Progress = silent,
) -> Path:
    """Look for objects in all pictures below a folder, and write COCO annotations with scores.

    They go to `detections.json` in `out` (default: the folder itself) beside the record `detect.json`, and can be
    imported together with a COLMAP model. Boxes are in the pixels as stored, whatever the EXIF orientation. The rest
    is as in `detect_dataset`.

    Returns
    -------
    Path
        The file of annotations.

    Raises
    ------
    OutputError
        `out` holds a `detections.json` that valuemap did not write, or cannot be written.
    """
    folder, config = Path(pictures), config or DetectConfig()
    target = Path(out) if out is not None else folder
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder", hint="give a dataset or a folder of pictures")
    paths = list_pictures(folder)
    if not paths:
        raise InputError(f"{folder}: there are no pictures in it", hint="give a dataset or a folder of pictures")
    if target.exists() and not target.is_dir():
        raise OutputError(f"{target}: is a file, a folder is to be written there", hint="name a folder with --out")
    check_files(target, (RESULTS, RECORD), force=force)
    names = [path.relative_to(folder).as_posix() for path in paths]
    with _Run(Path(model), config, target, [Task(path) for path in paths], names, engine) as run:
        run.finish(progress)
        with new_file(target / RESULTS, force=force) as path:
            _write_coco(path, run.detector, run.journal, names)
        run.write_record(force=force)
    return target / RESULTS


def detect_pictures(
    paths: Sequence[str | Path],
    model: str | Path,
    config: DetectConfig | None = None,
    *,
    progress: Progress = silent,
) -> list[PictureBoxes]:
    """Look for objects in pictures, and return what was found in each, in their order; nothing is written.

    Raises
    ------
    InputError, SettingError
        As `detect_dataset`, except that pictures which cannot be used are no error.
    """
    detector = Detector(Path(model), config or DetectConfig())
    found: list[PictureBoxes] = []
    with counted(progress, "pictures", len(paths)) as tell:
        for group in detector.run([Task(Path(path)) for path in paths]):
            for outcome in group:
                codes = outcome.boxes.class_code.tolist()
                classes = tuple(detector.wanted.name_of(code) for code in codes)
                path = Path(paths[len(found)])
                found.append(PictureBoxes(path, outcome.stored, outcome.boxes, classes, outcome.problem))
            tell(len(found))
    return found


class _Run:
    """A run over pictures by name, with its journal in the folder that the results go to.

    Where other processes look at the pictures the model is opened here for what it is called and takes, on any machine.
    """

    def __init__(
        self,
        model: Path,
        config: DetectConfig,
        folder: Path,
        tasks: Sequence[Task],
        names: Sequence[str],
        engine: Engine | None,
    ) -> None:
        self.config, self.folder, self.tasks, self.names = config, folder, tasks, names
        self.engine = engine if engine is not None and engine.needs_paths else None
        self.detector = Detector(model, config if self.engine is None else replace(config, provider="cpu"))
        self.seconds = 0.0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.journal = Journal(folder / _JOURNAL, self._identity(), config.batch)
        except OSError as error:
            raise OutputError(
                f"{folder}: cannot be written: {error.strerror}", hint="check the folder's permissions, or use --out"
            ) from error
        self.done = self.resumed_after = self.journal.done

    def __enter__(self) -> _Run:
        return self

    def __exit__(self, _: object, error: object, __: object) -> None:
        if self.done:
            self.journal.close()
        else:
            self.journal.remove()  # A model that cannot be run, say: there is nothing to go on from.
        if isinstance(error, OSError):
            raise OutputError(
                f"{self.folder}: cannot be written: {error.strerror or error}",
                hint="check the folder's permissions and free space; the same command then goes on from here",
            ) from error

    def finish(self, progress: Progress) -> None:
        """Run the pictures that the journal does not have yet.

        Raises
        ------
        InputError
            Not one of the pictures can be used.
        """
        start, total, found, written = time.perf_counter(), len(self.tasks), self.done, 0
        ahead: dict[int, list[Outcome]] = {}
        progress("pictures", found, total)
        for number, outcomes in self._outcomes():
            ahead[number] = outcomes
            while written in ahead:
                self.journal.write(ahead[written])
                self.done += len(ahead.pop(written))
                written += 1
            found += len(outcomes)
            progress("pictures", found, total)
        self.seconds = time.perf_counter() - start
        problems = [outcome.problem for outcome in self.journal.read()]
        if all(problems):
            self.journal.remove()
            raise InputError(
                f"{self.tasks[0].path}: {problems[0]} (none of {total} pictures can be used)",
                hint="are these the right pictures? Of a dataset, --images says where they are",
            )

    def _outcomes(self) -> Iterator[tuple[int, list[Outcome]]]:
        """Yield what became of the pictures that are to be looked at, in numbered groups, in any order."""
        tasks = self.tasks[self.done :]
        if self.engine is None:
            return enumerate(self.detector.run(tasks))
        return detect_in_shards(self.detector, self.config, tasks, self.engine)

    def write_record(self, *, force: bool) -> None:
        """Write detect.json and forget the journal."""
        unusable, found, turned, bare = [], Counter[str](), 0, 0
        for name, outcome in zip(self.names, self.journal.read(), strict=True):
            turned += outcome.was_turned
            bare += not outcome.has_structure
            found.update(map(self.detector.wanted.name_of, outcome.boxes.class_code.tolist()))
            if outcome.problem is not None:
                unusable.append({"image": name, "problem": outcome.problem})
        ran = len(self.tasks) - self.resumed_after
        record = {
            **self._identity(),
            "model_file": self.detector.model.path.name,
            "counts": {
                "pictures": len(self.tasks),
                "unusable_pictures": len(unusable),
                "pictures_of_noise_or_one_color": bare,
                "turned_by_exif": turned,
                "detections": found.total(),
                "detections_of_class": dict(sorted(found.items())),
            },
            "unusable": unusable,
            "pictures_of_an_interrupted_run": self.resumed_after,
            "seconds": round(self.seconds, 3),
            "pictures_a_second": round(ran / self.seconds, 2) if ran and self.seconds else None,
        }
        with new_file(self.folder / RECORD, force=force) as path:
            path.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
        self.journal.remove()

    def _identity(self) -> dict[str, Any]:
        """Return all that the result depends on."""
        model, config = self.detector.model, asdict(self.config)
        del config["decoders"]
        pictures = "\n".join(
            f"{name} {task.camera} {task.is_panorama}" for name, task in zip(self.names, self.tasks, strict=True)
        )
        return {
            "valuemap": version("valuemap"),
            "model_sha256": model.sha256,
            "model_kind": model.kind,
            "settings": {**config, "min_score": self.detector.min_score},
            "pictures_sha256": hashlib.sha256(pictures.encode()).hexdigest(),
        }


def _tasks_of(place: Path | UrlPath, names: Sequence[str], cameras: Cameras, images: Images) -> list[Task]:
    camera_row = rows_of(images.camera_id, cameras.camera_id)
    models = cameras.model.texts()
    return [
        Task(place / name, (int(cameras.width_px[row]), int(cameras.height_px[row])), models[row] == PANORAMA)
        for name, row in zip(names, camera_row, strict=True)
    ]


def _as_detections(detector: Detector, journal: Journal, images: Images) -> Detections:
    """Return all boxes as a table, numbered from 0 in the order of the images and then of the scores."""
    parts: list[Boxes] = []
    counts = []
    for outcome in journal.read():
        counts.append(len(outcome.boxes))
        if len(outcome.boxes):
            parts.append(outcome.boxes)
    boxes = Boxes.together(parts)
    return Detections(
        detection_id=np.arange(len(boxes)),
        image_id=np.repeat(images.image_id, counts),
        class_name=Categories.from_texts([detector.wanted.name_of(code) for code in boxes.class_code.tolist()]),
        center_px=boxes.center_px,
        size_px=boxes.size_px,
        score=boxes.score,
    )


def _write_coco(path: Path, detector: Detector, journal: Journal, names: Sequence[str]) -> None:
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for image_id, (name, outcome) in enumerate(zip(names, journal.read(), strict=True), start=1):
        if outcome.problem is not None:
            continue
        width, height = outcome.stored
        images.append({"id": image_id, "file_name": name, "width": width, "height": height})
        left_top = outcome.boxes.edges_px[:, :2]
        bbox = np.concatenate([left_top, outcome.boxes.size_px], axis=1).tolist()
        for box, score, code in zip(bbox, outcome.boxes.score.tolist(), outcome.boxes.class_code.tolist(), strict=True):
            annotations.append(
                {"id": len(annotations), "image_id": image_id, "category_id": code, "bbox": box, "score": score}
            )
    codes = sorted({annotation["category_id"] for annotation in annotations})
    categories = [{"id": code, "name": detector.wanted.name_of(code)} for code in codes]
    content = {"images": images, "annotations": annotations, "categories": categories}
    path.write_text(json.dumps(content) + "\n", encoding="utf-8")
