"""Laws that a map must keep, tried on real data: what means nothing may change nothing.

    python benchmarks/laws.py DATA_ROOT [--only NAME ...] [--law NAME ...] [--json FILE] [--method NAME]
                             [--set name=value ...]

DATA_ROOT as for `field.py`. Every data set is mapped as it is, and again after each change:

    detection ids   the detections are numbered anew, at random
    image ids       the images are numbered anew, at random; names and timestamps stay
    pass names      passes get other names, in another order
    split rigs      where several cameras drive together, each is a pass of its own
    threads         one thread
    moved           the world is turned about its up axis by 1 radian and moved by 100 m
    x 10, x 0.1     the world is larger or smaller, and so are all settings in metres

A law holds if every label has the same votes and class as one of the other map, and both lie within a millimetre of the
old world. Else the table says how many labels there were before and after, how many of both have the same votes, and
how far the farthest of these lie apart. With the paper's method the law of image ids cannot hold: the order of the
images decides where its clusters begin.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import av2_static
import bend_ramps
import kitti_signs
import kitti_ts
import london_tl
from field_data import Figures
from machine import describe_machine, keep_record
from valuemap.arrays import Floats, Ints
from valuemap.cameras import camera_centers
from valuemap.config import MapConfig, describe_settings
from valuemap.dataset import Dataset, Frame
from valuemap.errors import ValuemapError
from valuemap.map_folder import Map
from valuemap.pipeline import build_map
from valuemap.reach import with_usual_range
from valuemap.tables import Categories

SAME_M = 1e-3
TURN_RAD = 1.0
SHIFT_M = 100.0

DATASETS: dict[str, Callable[[Path], dict[str, Dataset]]] = {
    "kitti_signs": lambda folder: {name: kitti_signs.import_sequence(folder, name) for name in kitti_signs.SEQUENCES},
    "av2_static": lambda folder: {log[:8]: av2_static.load(folder, log) for log in av2_static.logs(folder)},
    "london_tl": lambda folder: {"london": london_tl.load(folder)},
    "kitti_ts": lambda folder: {"kitti_ts": kitti_ts.load(folder)},
    "bend_ramps": lambda folder: {"bend": bend_ramps.load(folder)},
}


@dataclass(frozen=True, eq=False)
class Changed:
    """A dataset and settings after a change, and how to compare what comes of them with what came before.

    `old_detection_id` (N) is what the detections, in their new order, were called. A point x of the old world lies at
    scale * turn(x) + shift_m in the new one.
    """

    dataset: Dataset
    config: MapConfig
    old_detection_id: Ints
    scale: float = 1.0
    turn: Rotation = dataclasses.field(default_factory=Rotation.identity)
    shift_m: Floats = dataclasses.field(default_factory=lambda: np.zeros(3))
    threads: int = 0

    def back(self, point_in_world_m: Floats) -> Floats:
        """Return points (N, 3) of the new world in the old one."""
        old: Floats = self.turn.inv().apply((point_in_world_m - self.shift_m) / self.scale)
        return old


@dataclass(frozen=True)
class Verdict:
    """How two maps compare: labels of each, how many of both have the same votes and class, and how far these are."""

    before: int
    after: int
    same: int
    farthest_m: float

    @property
    def holds(self) -> bool:
        """Whether the two are one map."""
        return self.before == self.after == self.same and self.farthest_m <= SAME_M

    def __str__(self) -> str:
        """Return what the table shows."""
        if self.holds:
            return "holds"
        return f"{self.before}, {self.after}; {self.same} same, {self.farthest_m:.1g} m"


Law = Callable[[Dataset, MapConfig, np.random.Generator], Changed | None]


def shuffle_detections(dataset: Dataset, config: MapConfig, random: np.random.Generator) -> Changed:
    """Give the detections new numbers."""
    detections = dataset.detections
    row = random.permutation(len(detections))
    shuffled = detections.take(row).replace(detection_id=np.arange(len(row)))
    return Changed(dataclasses.replace(dataset, detections=shuffled), config, detections.detection_id[row])


def shuffle_images(dataset: Dataset, config: MapConfig, random: np.random.Generator) -> Changed:
    """Give the images new numbers; each keeps its name, timestamp, pass and pose."""
    images, detections = dataset.images, dataset.detections
    row = random.permutation(len(images))
    new_row = np.argsort(row)
    image_id = new_row[np.searchsorted(images.image_id, detections.image_id)]
    changed = dataclasses.replace(
        dataset,
        images=images.take(row).replace(image_id=np.arange(len(row))),
        detections=detections.replace(image_id=image_id),
    )
    return Changed(changed, config, detections.detection_id)


def rename_passes(dataset: Dataset, config: MapConfig, random: np.random.Generator) -> Changed:
    """Give the passes names that sort in another order."""
    passes = dataset.images.pass_id
    names = [f"pass {number}" for number in random.permutation(len(passes.names)) + 10 ** len(str(len(passes.names)))]
    return _with_passes(dataset, config, [names[code] for code in passes.codes])


def split_rigs(dataset: Dataset, config: MapConfig, _: np.random.Generator) -> Changed | None:
    """Make each camera a pass of its own, where one pass has several."""
    passes, camera_id = dataset.images.pass_id, dataset.images.camera_id
    pairs = np.unique(np.column_stack([passes.codes, camera_id]), axis=0)
    if len(pairs) == len(np.unique(passes.codes)):
        return None
    names = [f"{passes.names[code]}/{camera}" for code, camera in zip(passes.codes, camera_id, strict=True)]
    return _with_passes(dataset, config, names)


def one_thread(dataset: Dataset, config: MapConfig, _: np.random.Generator) -> Changed:
    """Work on one thread."""
    return Changed(dataset, config, dataset.detections.detection_id, threads=1)


def move(dataset: Dataset, config: MapConfig, _: np.random.Generator) -> Changed:
    """Turn the world about its up axis, and move it."""
    turn = Rotation.from_rotvec(TURN_RAD * np.array(dataset.frame.up))
    return _placed(dataset, config, 1.0, turn, np.full(3, SHIFT_M))


def scaled(scale: float) -> Law:
    """Return the law of a world that is larger by a factor, with its settings."""

    def change(dataset: Dataset, config: MapConfig, _: np.random.Generator) -> Changed:
        return _placed(dataset, _scaled_settings(config, scale), scale, Rotation.identity(), np.zeros(3))

    return change


LAWS: dict[str, Law] = {
    "detection ids": shuffle_detections,
    "image ids": shuffle_images,
    "pass names": rename_passes,
    "split rigs": split_rigs,
    "threads": one_thread,
    "moved": move,
    "x 10": scaled(10.0),
    "x 0.1": scaled(0.1),
}


def check_laws(
    dataset: Dataset, config: MapConfig, names: list[str] | None = None, *, seed: int = 0
) -> dict[str, Verdict | None]:
    """Return what became of each law on a dataset; None where it says nothing about it."""
    before = build_map(dataset, config)
    verdicts: dict[str, Verdict | None] = {}
    for name in names or list(LAWS):
        changed = LAWS[name](dataset, config, np.random.default_rng(seed))
        if changed is None:
            verdicts[name] = None
            continue
        after = build_map(changed.dataset, changed.config, threads=changed.threads)
        verdicts[name] = compare_maps(before, after, changed)
    return verdicts


def compare_maps(before: Map, after: Map, changed: Changed) -> Verdict:
    """Compare two maps by the votes of their labels."""
    detection_id = changed.dataset.detections.detection_id
    old_id = changed.old_detection_id[np.searchsorted(detection_id, after.votes.detection_id)]
    place_before = before.labels.position_in_world_m
    place_after = changed.back(after.labels.position_in_world_m)
    of_before = _labels_by_votes(before, before.votes.detection_id)
    of_after = _labels_by_votes(after, old_id)
    same = [(of_before[key], of_after[key]) for key in of_before if key in of_after]
    apart_m = [float(np.linalg.norm(place_before[a] - place_after[b])) for a, b in same]
    return Verdict(len(before.labels), len(after.labels), len(same), max(apart_m, default=0.0))


def _labels_by_votes(result: Map, detection_id: Ints) -> dict[tuple[str, frozenset[int]], int]:
    """Return the row of the label of each class and set of votes."""
    votes: list[list[int]] = [[] for _ in range(len(result.labels))]
    rows = np.searchsorted(result.labels.label_id, result.votes.label_id)
    for row, detection in zip(rows.tolist(), detection_id.tolist(), strict=True):
        votes[row].append(detection)
    names = result.labels.class_name
    return {(names.names[names.codes[row]], frozenset(ids)): row for row, ids in enumerate(votes)}


def _with_passes(dataset: Dataset, config: MapConfig, names: list[str]) -> Changed:
    images = dataset.images.replace(pass_id=Categories.from_texts(names))
    return Changed(dataclasses.replace(dataset, images=images), config, dataset.detections.detection_id)


def _placed(dataset: Dataset, config: MapConfig, scale: float, turn: Rotation, shift_m: Floats) -> Changed:
    """Take the dataset to another place in the world, or another size."""
    images, detections = dataset.images, dataset.detections
    cam_from_world = Rotation.from_quat(images.cam_from_world_quat, scalar_first=True) * turn.inv()
    center = scale * turn.apply(camera_centers(images)) + shift_m

    def larger(values: Floats | None) -> Floats | None:
        return None if values is None else scale * values

    changed = dataclasses.replace(
        dataset,
        frame=Frame(up=dataset.frame.up),
        images=images.replace(
            cam_from_world_quat=cam_from_world.as_quat(canonical=True, scalar_first=True),
            cam_from_world_m=-cam_from_world.apply(center),
            position_sigma_m=larger(images.position_sigma_m),
        ),
        detections=detections.replace(
            range_m=larger(detections.range_m), range_sigma_m=larger(detections.range_sigma_m)
        ),
    )
    return Changed(changed, config, detections.detection_id, scale, turn, shift_m)


def _scaled_settings(config: MapConfig, scale: float) -> MapConfig:
    """Return the settings with all that are in metres multiplied, but for those that are estimated.

    Ranges, which are told from the data where they are not given, are multiplied too: those of streets.
    """
    config = with_usual_range(config)
    value = config.as_dict()
    metres = [name for name, _, unit, _ in describe_settings() if unit == "m" and value.get(name) is not None]
    metres = [name for name in metres if name not in config.ignored_settings()]
    return config.with_settings(f"{name}={float(value[name] or 0.0) * scale!r}" for name in metres)


def run(
    data_root: Path, config: MapConfig, only: list[str] | None = None, laws: list[str] | None = None
) -> dict[str, Figures]:
    """Check the laws on all data sets whose data is there, or on those named; print and return the verdicts."""
    names = [name for name in only or list(DATASETS) if (data_root / name).is_dir()]
    laws = laws or list(LAWS)
    results: dict[str, Figures] = {}
    for name in names:
        for part, dataset in DATASETS[name](data_root / name).items():
            verdicts = check_laws(dataset, config, laws)
            label = part if part in name or name.startswith(part) else f"{name} {part}"
            print(label)
            for law in laws:
                verdict = verdicts[law]
                print(f"    {law:16}{'-' if verdict is None else verdict}", flush=True)
            results[label] = {law: v and {**dataclasses.asdict(v), "holds": v.holds} for law, v in verdicts.items()}
    kept = [verdict["holds"] for part in results.values() for verdict in part.values() if verdict]
    print(f"{sum(kept)} of {len(kept)} hold")
    return results


def main() -> int:
    """Check the laws; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data_root", type=Path, metavar="DATA_ROOT")
    parser.add_argument("--only", nargs="+", choices=list(DATASETS), metavar="NAME", help=f"of {', '.join(DATASETS)}")
    parser.add_argument("--law", nargs="+", choices=list(LAWS), metavar="NAME", help=f"of {', '.join(LAWS)}")
    parser.add_argument("--json", type=Path, help="write the verdicts, settings and machine there")
    parser.add_argument("--method", default=MapConfig().method)
    parser.add_argument("--set", action="append", default=[], metavar="name=value", dest="settings")
    options = parser.parse_args()
    try:
        config = MapConfig(method=options.method).with_settings(options.settings)
        results = run(options.data_root, config, options.only, options.law)
        record = {"benchmark": "laws", "command": "python benchmarks/laws.py DATA_ROOT", **describe_machine()}
        keep_record(options.json, {**record, "settings": config.as_dict(), "results": results})
    except ValuemapError as error:
        print(f"error: {error}\nhint: {error.hint}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
