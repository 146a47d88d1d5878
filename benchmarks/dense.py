"""How good a map is where objects stand close together, and where detector, poses or drives are at their worst.

Scenes of simulated streets. Dense ones: rows of two to six signs side by side, street lamps, trees, posts along both
sides of every street, driven six times in each direction (posts three times). Hard ones: the lights of `robust.py` with
one fault of the detector, of the poses or of the drives each, or with an image every 20 m (`sparse`). All settings of
the method are its defaults.

Counted over all seeds of a scene: recall of the objects whose Cramer-Rao bound (`bound.py`; root of the trace) is at
most 0.5 m and that have enough detections; precision, of all labels; duplicates, labels that only lack an object
because another label took it; the mean squared normalised error of the right labels (3 if covariances are honest).
A label is right within 1 m of an object of its class, or within 3 m and three of its own standard deviations; labels
and objects are matched one to one, most matches first, then least distance. One that is not right, but of whose votes
more than half show one object with a larger bound, is left out: nobody can tell where that is.

Time per detection is that of `build_map`, of the clock and of the processor (all threads; the one to compare where
others use the machine as well); `--nyc` measures the `nyc` preset in the same run and says how many times longer
scenes take.
`--small` takes a small part of each scene, for quick looks while working on the method; `--radius` a larger part.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

import valuemap
from bound import cramer_rao_covariances, true_views
from cities import city, ratio, seeds_from
from machine import write_record
from more_data import part_of
from valuemap.arrays import Bools, Floats, Ints
from valuemap.config import SimulationConfig
from valuemap.dataset import Dataset, rows_of, write_dataset
from valuemap.simulate import PRESETS, Recording, record_city, simulate
from valuemap.tables.covariance import covariance_matrices

RIGHT_SIGMAS = 3.0


@dataclass(frozen=True)
class Scene:
    """What is simulated; for quick looks, only images within `small_radius_m` of the middle of a street, or less city.

    Objects count that have `min_detections` and whose bound is at most `max_bound_m`. Labels are right within the first
    distance of `right_m`, and within the second if their own covariance says so.
    """

    config: SimulationConfig
    small_radius_m: float = 0.0
    small_city: SimulationConfig | None = None
    min_detections: int = 3
    max_bound_m: float = 0.5
    right_m: tuple[float, float] = (1.0, 3.0)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of one scene of one seed: `labels` are those that count, `normalised_error` (N) of right ones."""

    objects: int
    found: int
    labels: int
    right: int
    duplicates: int
    normalised_error: Floats
    images: int
    detections: int
    seconds: float
    cpu_seconds: float


def along_streets(passes: int = 6, **changes: float) -> SimulationConfig:
    """Return three by three streets without lights, driven so often in each direction, with what `changes` adds."""
    settings = {"streets_north_south": 3, "streets_east_west": 3, "has_lights": 0, "lookalikes_per_light": 0.0}
    settings |= {"passes_per_street": passes, **changes}
    return dataclasses.replace(SimulationConfig(), **settings)  # type: ignore[arg-type]


def with_lights(passes: int = 6, **changes: float) -> Scene:
    """Return the city of `robust.py` with a fault; for quick looks a part of it, driven less often."""
    small = {"streets_north_south": 2, "streets_east_west": 2}
    return Scene(city(passes, **changes), small_city=city(min(max(passes // 2, 3), 5), **{**small, **changes}))


GPS: dict[str, Any] = {
    "position_white_m": 0.2,
    "position_middle_m": 0.3,
    "position_drift_m": 1.5,
    "rotation_white_deg": 0.2,
    "rotation_drift_deg": 0.5,
    "write_pose_sigmas": 1,
}
"""Poses as of a receiver for satellites and a compass, and said to be."""

MIDDLE: dict[str, Any] = {
    "position_white_m": 0.04,
    "position_middle_m": 0.1,
    "position_drift_m": 0.05,
    "rotation_white_deg": 0.05,
    "rotation_middle_deg": 0.13,
    "rotation_drift_deg": 0.05,
}
"""Poses whose errors change over 15 m most of all; as large as by default in all."""

SCENES: dict[str, Scene] = {
    "signs-0.9": Scene(along_streets(sign_row_spacing_m=30.0, sign_apart_m=0.9), 45.0),
    "signs-0.5": Scene(along_streets(sign_row_spacing_m=30.0, sign_apart_m=0.5), 45.0),
    "lamps-25": Scene(along_streets(lamp_spacing_m=25.0), 60.0),
    "trees-10": Scene(along_streets(tree_spacing_m=10.0, max_sight_m=60.0), 40.0),
    "trees-6": Scene(along_streets(tree_spacing_m=6.0, max_sight_m=60.0), 25.0),
    "posts-3": Scene(along_streets(3, post_spacing_m=3.0, max_sight_m=60.0), 16.0),
    "clutter1": with_lights(20, clutter_per_image=1.0),
    "poor": dataclasses.replace(with_lights(5, recall_mean=0.3, clutter_per_image=0.5), min_detections=8),
    "doubles-8": with_lights(double_share=0.08),
    "doubles-all": with_lights(double_share=1.0),
    "edge": with_lights(min_visible_share=0.3, partly_hidden_share=0.1),
    "tails": with_lights(tail_share=0.05),
    "tails-10": with_lights(tail_share=0.1),
    "tails-trees": Scene(along_streets(tree_spacing_m=10.0, max_sight_m=60.0, tail_share=0.1), 40.0),
    "tails-signs": Scene(along_streets(sign_row_spacing_m=30.0, sign_apart_m=0.9, tail_share=0.1), 45.0),
    "shapes": with_lights(size_spread=0.2, side_offset_m=0.15),
    "shapes-lamps": Scene(along_streets(lamp_spacing_m=25.0, side_offset_m=0.15), 60.0),
    "middle": with_lights(**MIDDLE),
    "classes": with_lights(class_confusion=0.1, sign_row_spacing_m=40.0),
    "two-cameras": with_lights(cameras=2, camera_folders=0),
    "two-passes": with_lights(cameras=2, camera_folders=1, pass_per_camera=1),
    "shuffled": with_lights(shuffle_ids=1),
    "shuffled-names": with_lights(shuffle_ids=1, shuffle_names=1, write_timestamps=0),
    "revisit": with_lights(1, laps=6),
    "sparse": with_lights(2, frame_spacing_m=20.0),
    "gps": dataclasses.replace(with_lights(**GPS), max_bound_m=1.5, right_m=(2.0, 5.0)),
}


def main() -> None:
    """Run the benchmark and print a line for each scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=SCENES, default=list(SCENES), metavar="SCENE")
    parser.add_argument("--seeds", nargs="+", default=["0..4"], metavar="N|FIRST..LAST")
    parser.add_argument("--small", action="store_true", help="a small part of each scene")
    parser.add_argument(
        "--radius", type=float, help="radius in m of the part of a dense scene, instead of that of --small"
    )
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="NAME=VALUE", help="of the map")
    parser.add_argument("--nyc", action="store_true", help="measure the time per detection of the nyc preset as well")
    parser.add_argument("--save", type=Path, help="folder to write the datasets to")
    parser.add_argument("--json", type=Path, help="file to write the figures to")
    options = parser.parse_args()
    config = valuemap.MapConfig().with_settings(options.settings)
    results: list[dict[str, Any]] = []
    if options.nyc:
        results.append(_time_of_nyc(config))
        print(line(results[-1]), flush=True)
    for name in options.only:
        scene, outcomes = SCENES[name], []
        if options.small and options.radius and scene.small_radius_m:
            scene = dataclasses.replace(scene, small_radius_m=options.radius)
        for seed in seeds_from(options.seeds):
            recording = record_scene(scene, seed, is_small=options.small)
            if options.save is not None:
                write_dataset(recording.dataset, options.save / f"{name}-{seed}")
            outcomes.append(measure(recording, config, scene))
        figures = {"name": name, **add_up(outcomes)}
        if options.nyc:
            cpu_times = figures["cpu_microseconds_per_detection"] / results[0]["cpu_microseconds_per_detection"]
            figures["cpu_times_nyc"] = round(cpu_times, 4)
        results.append(figures)
        print(line(results[-1]), flush=True)
    write_record(options.json, results)


def record_scene(scene: Scene, seed: int, *, is_small: bool) -> Recording:
    """Simulate a scene, or the small part of it."""
    if not is_small:
        return record_city(scene.config, seed=seed, name="scene")
    if scene.small_city is not None:
        return record_city(scene.small_city, seed=seed, name="scene")
    recording = record_city(scene.config, seed=seed, name="scene")
    ends = recording.city.streets.center_m(np.array([[1, 0], [1, 1]]))
    from_middle = recording.frames.center_in_world_m[:, :2] - ends.mean(axis=0)
    return part_of_recording(recording, np.hypot(*from_middle.T) <= scene.small_radius_m)


def part_of_recording(recording: Recording, rows: Bools) -> Recording:
    """Return a recording with some of its images (N) only."""
    dataset = part_of(recording.dataset, rows)
    new_row = np.cumsum(rows) - 1
    is_kept, is_sighted = rows[recording.boxes.frame_row], rows[recording.sightings.frame_row]
    boxes, sightings = recording.boxes.take(is_kept), recording.sightings.take(is_sighted)
    return dataclasses.replace(
        recording,
        frames=recording.frames.take(rows),
        sightings=sightings.replace(frame_row=new_row[sightings.frame_row]),
        is_hidden=recording.is_hidden[is_sighted],
        boxes=boxes.replace(frame_row=new_row[boxes.frame_row]),
        dataset=dataset,
    )


def measure(recording: Recording, config: valuemap.MapConfig, scene: Scene) -> Outcome:
    """Map a recording and compare with the truth."""
    dataset = recording.dataset
    result, seconds, cpu_seconds = _timed_map(dataset, config)
    is_bound, is_detected = objects_that_count(recording, scene)
    counts = is_bound & is_detected
    labels = result.labels
    assert dataset.truth is not None
    covariance = covariance_matrices(labels.stated_covariance_m2)
    class_code = np.array([dataset.truth.class_name.code_of(name) for name in labels.class_name.names], dtype=np.int64)
    error = labels.position_in_world_m[:, None] - dataset.truth.position_in_world_m
    squared = np.einsum("loi,lij,loj->lo", error, np.linalg.inv(covariance), error)
    is_near = is_right(np.linalg.norm(error, axis=2), squared, scene.right_m)
    is_near &= class_code[labels.class_name.codes][:, None] == dataset.truth.class_name.codes
    label, matched = match_one_to_one(np.linalg.norm(error, axis=2), is_near)
    is_alone = np.ones(len(labels), dtype=np.bool_)
    is_alone[label] = False
    left_out = is_alone & show_mostly(result, dataset, ~is_bound)
    return Outcome(
        objects=int(counts.sum()),
        found=int(counts[matched].sum()),
        labels=int((~left_out).sum()),
        right=len(label),
        duplicates=int((is_alone & ~left_out & is_near.any(axis=1)).sum()),
        normalised_error=squared[label, matched],
        images=len(dataset.images),
        detections=len(dataset.detections),
        seconds=seconds,
        cpu_seconds=cpu_seconds,
    )


def _timed_map(dataset: Dataset, config: valuemap.MapConfig) -> tuple[valuemap.Map, float, float]:
    """Return the map, and the seconds of the clock and of the processor that it took."""
    start, cpu_start = time.perf_counter(), time.process_time()
    result = valuemap.build_map(dataset, config)
    return result, time.perf_counter() - start, time.process_time() - cpu_start


def objects_that_count(recording: Recording, scene: Scene) -> tuple[Bools, Bools]:
    """Return which true objects (N) have a small bound, and which have enough detections: those with both count."""
    truth, shown = recording.dataset.truth, recording.dataset.truth_detections
    assert truth is not None
    assert shown is not None
    bound = cramer_rao_covariances(true_views(recording), recording.config, len(truth))
    detections = np.bincount(rows_of(shown.object_id, truth.object_id), minlength=len(truth))
    return np.trace(bound, axis1=1, axis2=2) <= scene.max_bound_m**2, detections >= scene.min_detections


def show_mostly(result: valuemap.Map, dataset: Dataset, objects: Bools) -> Bools:
    """Return which labels (N) have more than half of their votes from one object, and that of certain ones (M)."""
    truth, shown = dataset.truth, dataset.truth_detections
    assert truth is not None
    assert shown is not None
    shows = np.full(len(dataset.detections), -1)
    shows[rows_of(shown.detection_id, dataset.detections.detection_id)] = rows_of(shown.object_id, truth.object_id)
    of_vote = shows[rows_of(result.votes.detection_id, dataset.detections.detection_id)]
    label = rows_of(result.votes.label_id, result.labels.label_id)
    others = (of_vote >= 0) & objects[of_vote]
    pairs, votes = np.unique(np.stack([label[others], of_vote[others]]), axis=1, return_counts=True)
    most = 2 * votes > result.labels.votes[pairs[0]]
    return np.asarray(np.isin(np.arange(len(result.labels)), pairs[0, most]))


def is_right(distance_m: Floats, squared_sigmas: Floats, right_m: tuple[float, float]) -> Bools:
    """Return which labels are right for which objects, from distances and squared Mahalanobis distances (any shape)."""
    near_m, far_m = right_m
    right: Bools = (distance_m <= near_m) | ((distance_m <= far_m) & (squared_sigmas <= RIGHT_SIGMAS**2))
    return right


def match_one_to_one(distance_m: Floats, is_near: Bools) -> tuple[Ints, Ints]:
    """Return rows and columns of the pairs of most matches and, of such choices, of the least sum of distances."""
    # One that is no match costs more than all matches together.
    cost = np.where(is_near, distance_m, 1.0 + 2.0 * min(distance_m.shape) * distance_m.max(initial=0.0, where=is_near))
    rows, columns = linear_sum_assignment(cost)
    matched = is_near[rows, columns]
    return rows[matched], columns[matched]


def add_up(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return the figures of several seeds together."""
    total = {name: sum(getattr(o, name) for o in outcomes) for name in ("images", "detections", "objects", "labels")}
    normalised = np.concatenate([o.normalised_error for o in outcomes])
    figures = {
        "recall": ratio(sum(o.found for o in outcomes), total["objects"]),
        "precision": ratio(sum(o.right for o in outcomes), total["labels"]),
        "duplicates_per_label": ratio(sum(o.duplicates for o in outcomes), total["labels"]),
        "mean_normalised_error": float(normalised.mean()) if len(normalised) else 0.0,
        "median_normalised_error": float(np.median(normalised)) if len(normalised) else 0.0,
        "detections_per_image": ratio(total["detections"], total["images"]),
    }
    figures |= _times(sum(o.seconds for o in outcomes), sum(o.cpu_seconds for o in outcomes), total["detections"])
    return {"seeds": len(outcomes), **total, **{name: round(value, 4) for name, value in figures.items()}}


def _times(seconds: float, cpu_seconds: float, detections: int) -> dict[str, float]:
    return {
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "microseconds_per_detection": 1e6 * ratio(seconds, detections),
        "cpu_microseconds_per_detection": 1e6 * ratio(cpu_seconds, detections),
    }


def _time_of_nyc(config: valuemap.MapConfig) -> dict[str, Any]:
    dataset: Dataset = simulate(PRESETS["nyc"], seed=0)
    _, seconds, cpu_seconds = _timed_map(dataset, config)
    times = _times(seconds, cpu_seconds, len(dataset.detections))
    return {
        "name": "nyc preset (time only)",
        "images": len(dataset.images),
        "detections": len(dataset.detections),
        "detections_per_image": round(ratio(len(dataset.detections), len(dataset.images)), 4),
        **{name: round(value, 4) for name, value in times.items()},
    }


def line(figures: dict[str, Any]) -> str:
    """Return the figures of a scene in one line."""
    cost = (
        f"{figures['detections']:7d} detections ({figures['detections_per_image']:.1f} per image)  "
        f"{figures['microseconds_per_detection']:.0f} us per detection (cpu "
        f"{figures['cpu_microseconds_per_detection']:.0f}"
        + (f", {figures['cpu_times_nyc']:.1f} times nyc)" if "cpu_times_nyc" in figures else ")")
        + f"  {figures['seconds']:.1f} s"
    )
    if "recall" not in figures:
        return f"{figures['name']:24} {cost}"
    return (
        f"{figures['name']:12} objects {figures['objects']:4d}  labels {figures['labels']:4d}  "
        f"recall {figures['recall']:.4f}  precision {figures['precision']:.4f}  "
        f"duplicates {figures['duplicates_per_label']:.4f}  "
        f"normalised error {figures['mean_normalised_error']:.2f} (median {figures['median_normalised_error']:.2f})  "
        f"{cost}"
    )


if __name__ == "__main__":
    main()
