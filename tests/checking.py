"""What tests of checks ask of data, and what they put into it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from check_faults import good_city
from valuemap.arrays import Floats
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.check import examine
from valuemap.check.contest import hold_contest
from valuemap.check.fault import Finding, View, with_poses
from valuemap.check.registry import CONVENTIONS, FAULTS
from valuemap.dataset import Dataset
from valuemap.simulate import PRESETS

FAULT_NAMED = {fault.name: fault for fault in FAULTS}
LOOSE = replace(
    PRESETS["small"], position_white_m=0.4, position_drift_m=1.5, rotation_white_deg=0.3, rotation_drift_deg=0.8
)
"""Poses as of a phone: metres and most of a degree off."""


def one_pass(seed: int, **changes: float) -> Dataset:
    """Return a small city that each street of is driven once."""
    return good_city(seed, passes_per_street=1, **changes)


def convention_told(dataset: Dataset) -> Finding:
    """Return what is said of the conventions of a dataset, of which something must be."""
    finding = hold_contest(View(dataset), CONVENTIONS).finding
    assert finding is not None
    return finding


def named(dataset: Dataset) -> list[str]:
    return [finding.fault for finding in examine(dataset).findings]


def degrees_off(dataset: Dataset, right: Dataset) -> Floats:
    """Return by how many degrees each image (N) is turned against another version of the dataset."""
    off = rotation_matrices(dataset.images) @ rotation_matrices(right.images).transpose(0, 2, 1)
    return np.asarray(np.degrees(Rotation.from_matrix(off).magnitude()))


def turned_by(dataset: Dataset, axis: str, degrees: float) -> Dataset:
    turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return with_poses(dataset, turn @ rotation_matrices(dataset.images), camera_centers(dataset.images))
