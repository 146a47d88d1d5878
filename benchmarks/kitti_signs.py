"""Real traffic signs on KITTI odometry sequences 00, 05, 07, 09: import, map and evaluate with one command.

    python benchmarks/kitti_signs.py DATA_DIR [--out DIR] [--json FILE] [--method NAME] [--set name=value ...]

DATA_DIR holds `meta.json` (a key a sequence: image_size, fx, fy, cx, cy) and a folder a sequence with
`poses_cam2.txt`, `detections.csv` (hand-made boxes of Chawla et al. 2020), `gt.csv` (surveyed signs, of which
those with evaluable = 1 are seen in two boxed frames) and `reference_tracks.csv` (boxes tracked from frame to
frame and triangulated robustly). The survey has part of the signs only, so it says which are found, and never
which labels are false.

What is counted

    signs found       evaluable surveyed signs with a label within 2, 1 and 0.5 m
    right labels      within 1 m of a reference track or 2 m of any surveyed sign; over all labels: precision
    distinct labels   matched one to one with objects, where an object is a track together with the surveyed
                      sign that it belongs to, or a sign without a track; the other right ones are duplicates
    tracks found      reference tracks with a label within 1 m, and the same matched one to one
    distance          of labels to the tracks they are matched with
    distance, survey  of labels to the evaluable signs they are matched with within 2 m, over the signs that both this
                      method and `paper` (with the same other settings) find, so that the two medians compare
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyarrow import csv
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from field_data import Change, as_it_is
from machine import describe_machine, keep_record
from valuemap.config import MapConfig
from valuemap.dataset import Dataset, write_dataset
from valuemap.errors import InputError, ValuemapError
from valuemap.map_folder import write_map
from valuemap.pipeline import build_map
from valuemap.readers.kitti import read_kitti

SEQUENCES = ("00", "05", "07", "09")
SIGN_RADII_M = (2.0, 1.0, 0.5)
TRACK_RADIUS_M = 1.0

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Score:
    """Counts of one sequence or of several; `distance_m` (N) of labels to the tracks matched with them.

    `sign_distance_m` (M) of the evaluable signs to the labels matched with them, NaN where there is none, and
    `paper_sign_distance_m` (M) the same of the paper's method.
    """

    labels: int
    right_labels: int
    distinct_labels: int
    signs: int
    signs_found: tuple[int, ...]
    signs_matched: tuple[int, ...]
    tracks: int
    tracks_found: int
    tracks_matched: int
    distance_m: Floats
    sign_distance_m: Floats
    paper_sign_distance_m: Floats
    seconds: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """Return counts, ratios and the median distance by name."""
        radii = [f"{radius:g}m" for radius in SIGN_RADII_M]
        both = np.isfinite(self.sign_distance_m) & np.isfinite(self.paper_sign_distance_m)
        return {
            "labels": self.labels,
            "right_labels": self.right_labels,
            "false_labels": self.labels - self.right_labels,
            "duplicate_labels": self.right_labels - self.distinct_labels,
            "precision": _ratio(self.right_labels, self.labels),
            "precision_one_to_one": _ratio(self.distinct_labels, self.labels),
            "signs": self.signs,
            **{f"signs_found_{radius}": n for radius, n in zip(radii, self.signs_found, strict=True)},
            **{f"signs_one_to_one_{radius}": n for radius, n in zip(radii, self.signs_matched, strict=True)},
            "tracks": self.tracks,
            "tracks_found": self.tracks_found,
            "tracks_one_to_one": self.tracks_matched,
            "track_recall": _ratio(self.tracks_found, self.tracks),
            "track_recall_one_to_one": _ratio(self.tracks_matched, self.tracks),
            "median_distance_m": median(self.distance_m),
            "signs_of_both": int(both.sum()),
            "median_distance_survey_m": median(self.sign_distance_m[both]),
            "median_distance_survey_paper_m": median(self.paper_sign_distance_m[both]),
            "map_seconds": round(self.seconds, 2),
        }


def main() -> int:
    """Run the benchmark; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data_dir", type=Path, metavar="DATA_DIR")
    parser.add_argument("--out", type=Path, help="write the dataset and the map of each sequence there")
    parser.add_argument("--json", type=Path, help="write the figures, settings and machine there")
    parser.add_argument("--method", default=MapConfig().method)
    parser.add_argument("--set", action="append", default=[], metavar="name=value", dest="settings")
    options = parser.parse_args()
    try:
        config = MapConfig(method=options.method).with_settings(options.settings)
        scores = {sequence: run_sequence(options.data_dir, sequence, config, options.out) for sequence in SEQUENCES}
        results = {name: score.to_json() for name, score in {**scores, "total": add_up(scores)}.items()}
        print(_table(results))
        keep_record(options.json, _record(options, config, results))
    except ValuemapError as error:
        print(f"error: {error}\nhint: {error.hint}", file=sys.stderr)
        return 1
    return 0


def import_sequence(data_dir: Path, sequence: str) -> Dataset:
    """Read one sequence of the folder as a dataset.

    Raises
    ------
    InputError
        A file is not there, or damaged.
    """
    camera = _meta(data_dir, sequence)
    return read_kitti(
        data_dir / sequence / "poses_cam2.txt",
        intrinsics=(camera["fx"], camera["fy"], camera["cx"], camera["cy"]),
        image_size=tuple(camera["image_size"]),
        detections=data_dir / sequence / "detections.csv",
        class_name="sign",
    )


def run(data_dir: Path, config: MapConfig, change: Change = as_it_is) -> dict[str, dict[str, Any]]:
    """Map and score every sequence, and all together."""
    scores = {sequence: run_sequence(data_dir, sequence, config, None, change) for sequence in SEQUENCES}
    return {name: score.to_json() for name, score in {**scores, "total": add_up(scores)}.items()}


def run_sequence(
    data_dir: Path, sequence: str, config: MapConfig, out: Path | None, change: Change = as_it_is
) -> Score:
    """Import, map and evaluate one sequence; keep dataset and map under `out`."""
    dataset = change(import_sequence(data_dir, sequence))
    start = time.perf_counter()
    result = build_map(dataset, config)
    seconds = time.perf_counter() - start
    if out is not None:
        write_dataset(dataset, out / sequence / "dataset")
        write_map(result, out / sequence / "map")
    signs, is_evaluable = read_signs(data_dir / sequence / "gt.csv")
    tracks = read_points(data_dir / sequence / "reference_tracks.csv")
    score = score_labels(result.labels.position_in_world_m, signs, is_evaluable, tracks, seconds=seconds)
    if config.method != "paper":
        by_paper = build_map(dataset, dataclasses.replace(config, method="paper")).labels.position_in_world_m
        score = dataclasses.replace(score, paper_sign_distance_m=sign_distances(by_paper, signs[is_evaluable]))
    return score


def score_labels(labels: Floats, signs: Floats, is_evaluable: Bools, tracks: Floats, *, seconds: float = 0.0) -> Score:
    """Count what became of labels (N, 3), signs (M, 3) and tracks (K, 3), in metres in one frame."""
    to_signs, to_tracks = cdist(labels, signs), cdist(labels, tracks)
    near_sign, near_track = to_signs <= max(SIGN_RADII_M), to_tracks <= TRACK_RADIUS_M
    to_evaluable = to_signs[:, is_evaluable]

    # An object is a track, with its sign if it has one, or a sign alone.
    track_of_sign, sign_of_track = match_one_to_one(cdist(tracks, signs), cdist(tracks, signs) <= max(SIGN_RADII_M))
    near_object = near_track.copy()
    near_object[:, track_of_sign] |= near_sign[:, sign_of_track]
    near_object = np.hstack([near_object, np.delete(near_sign, sign_of_track, axis=1)])

    track_label, track = match_one_to_one(to_tracks, near_track)
    sign_distance_m = sign_distances(labels, signs[is_evaluable])
    return Score(
        labels=len(labels),
        right_labels=int((near_sign.any(axis=1) | near_track.any(axis=1)).sum()),
        distinct_labels=len(match_one_to_one(np.zeros(near_object.shape), near_object)[0]),
        signs=int(is_evaluable.sum()),
        signs_found=tuple(int((to_evaluable <= radius).any(axis=0).sum()) for radius in SIGN_RADII_M),
        signs_matched=tuple(len(match_one_to_one(to_evaluable, to_evaluable <= radius)[0]) for radius in SIGN_RADII_M),
        tracks=len(tracks),
        tracks_found=int(near_track.any(axis=0).sum()),
        tracks_matched=len(track),
        distance_m=to_tracks[track_label, track],
        sign_distance_m=sign_distance_m,
        paper_sign_distance_m=sign_distance_m,
        seconds=seconds,
    )


def sign_distances(labels: Floats, signs: Floats) -> Floats:
    """Return the distance (M) of each sign (M, 3) to the label (N, 3) matched with it, NaN where there is none."""
    distance_m = cdist(labels, signs)
    label, sign = match_one_to_one(distance_m, distance_m <= max(SIGN_RADII_M))
    distance_of_sign_m = np.full(len(signs), np.nan)
    distance_of_sign_m[sign] = distance_m[label, sign]
    return distance_of_sign_m


def match_one_to_one(distance_m: Floats, is_allowed: Bools) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of the most allowed pairs, and of such choices the one with least distance."""
    never = 1.0 + 2.0 * float(distance_m[is_allowed].sum())
    row, column = linear_sum_assignment(np.where(is_allowed, distance_m, never))
    kept = is_allowed[row, column]
    return row[kept], column[kept]


def add_up(scores: dict[str, Score]) -> Score:
    """Return the score of all sequences together."""
    each = list(scores.values())
    return Score(
        labels=sum(s.labels for s in each),
        right_labels=sum(s.right_labels for s in each),
        distinct_labels=sum(s.distinct_labels for s in each),
        signs=sum(s.signs for s in each),
        signs_found=tuple(map(sum, zip(*(s.signs_found for s in each), strict=True))),
        signs_matched=tuple(map(sum, zip(*(s.signs_matched for s in each), strict=True))),
        tracks=sum(s.tracks for s in each),
        tracks_found=sum(s.tracks_found for s in each),
        tracks_matched=sum(s.tracks_matched for s in each),
        distance_m=np.concatenate([s.distance_m for s in each]),
        sign_distance_m=np.concatenate([s.sign_distance_m for s in each]),
        paper_sign_distance_m=np.concatenate([s.paper_sign_distance_m for s in each]),
        seconds=sum(s.seconds for s in each),
    )


def read_points(path: Path) -> Floats:
    """Return the columns x, y, z (N, 3) of a CSV file."""
    table = _read_csv(path)
    return np.stack([table[axis].to_numpy() for axis in "xyz"], axis=1)


def read_signs(path: Path) -> tuple[Floats, Bools]:
    """Return the positions (N, 3) of the surveyed signs, and which of them (N) are evaluable."""
    return read_points(path), _read_csv(path)["evaluable"].to_numpy() == 1


def _read_csv(path: Path) -> Any:
    if not path.is_file():
        raise InputError(f"{path}: no such file", hint="give the folder described at the top of this script")
    return csv.read_csv(path)


def _meta(data_dir: Path, sequence: str) -> dict[str, Any]:
    path = data_dir / "meta.json"
    if not path.is_file():
        raise InputError(f"{path}: no such file", hint="give the folder described at the top of this script")
    camera: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))[sequence]
    return camera


def median(values: Floats) -> float | None:
    """Return the median with three digits; None of nothing."""
    return round(float(np.median(values)), 3) if len(values) else None


def _ratio(part: int, whole: int) -> float | None:
    return round(part / whole, 4) if whole else None


def _table(results: dict[str, dict[str, Any]]) -> str:
    """Return one column a sequence and one line a figure."""
    names = list(results["total"])
    lines = [f"{'':26}" + "".join(f"{sequence:>9}" for sequence in results)]
    for name in names:
        values = (results[sequence][name] for sequence in results)
        lines.append(f"{name:26}" + "".join(f"{'-' if value is None else value:>9}" for value in values))
    return "\n".join(lines)


def _record(options: argparse.Namespace, config: MapConfig, results: dict[str, Any]) -> dict[str, Any]:
    settings = "".join(f" --set {assignment}" for assignment in options.settings)
    return {
        "benchmark": "kitti_signs",
        "data": "KITTI odometry sequences 00, 05, 07, 09 with hand-made sign boxes, see the script",
        "command": f"python benchmarks/kitti_signs.py DATA_DIR --method {options.method}{settings}",
        **describe_machine(),
        "settings": config.as_dict(),
        "results": results,
    }


if __name__ == "__main__":
    sys.exit(main())
