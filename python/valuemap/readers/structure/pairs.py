"""Which pictures are matched with which, and their matches, in the database."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from valuemap.colmap import pycolmap
from valuemap.progress import Progress
from valuemap.readers.structure.features import image_ids
from valuemap.readers.structure.job import DATABASE, Job

_CHUNK_PAIRS = 64
_FOLLOWING = (1, 2, 3, 4, 5, 6, 8, 12)
"""Steps along a drive: near ones hold it together at turns, far ones keep it straight."""
_AROUND, _AROUND_M = 8, 25.0


def pairs_to_match(job: Job) -> list[tuple[int, int]]:
    """Return pairs of rows: those that follow each other in a drive, and the nearest by GPS of others."""
    place, drive = np.zeros(len(job.pictures), dtype=np.int64), np.zeros(len(job.pictures), dtype=np.int64)
    drives: dict[str, list[int]] = {}
    for row, picture in enumerate(job.pictures):
        drives.setdefault(picture.drive, []).append(row)
    found: set[tuple[int, int]] = set()
    for number, rows in enumerate(drives.values()):
        place[rows], drive[rows] = np.arange(len(rows)), number
        found |= {(rows[i], rows[i + step]) for step in _FOLLOWING for i in range(len(rows) - step)}
    gps = job.gps_in_world_m()
    located = np.flatnonzero(np.isfinite(gps).all(axis=1))
    if len(located) > 1:
        tree = cKDTree(gps[located])
        for row, near in zip(located.tolist(), tree.query_ball_point(gps[located], _AROUND_M), strict=True):
            others = located[near]
            apart = (drive[others] != drive[row]) | (np.abs(place[others] - place[row]) > _FOLLOWING[-1])
            others = others[apart]
            far = np.linalg.norm(gps[others] - gps[row], axis=1)
            for other in others[np.argsort(far, kind="stable")[:_AROUND]].tolist():
                found.add((min(row, other), max(row, other)))
    return sorted(found)


def match_pairs(job: Job, workspace: Path, *, threads: int, progress: Progress) -> None:
    """Match pairs in chunks; those that were matched before are passed over by pycolmap."""
    known = image_ids(job, workspace)
    pairs = [(a, b) for a, b in pairs_to_match(job) if a in known and b in known]
    options, geometry = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    options.num_threads, options.use_gpu = threads, False
    geometry.ransac.random_seed = 0
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = workspace / "pairs.txt"
    for start in range(0, len(pairs), _CHUNK_PAIRS):
        progress("matching pictures", start, len(pairs))
        lines = [f"{job.alias(a)} {job.alias(b)}" for a, b in pairs[start : start + _CHUNK_PAIRS]]
        (workspace / "pairs.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
        pycolmap.match_image_pairs(
            workspace / DATABASE,
            matching_options=options,
            pairing_options=pairing,
            verification_options=geometry,
            device=pycolmap.Device.cpu,
        )
    progress("matching pictures", len(pairs), len(pairs))
