"""How far labels are from their objects, and how far the map says that they may be."""

from __future__ import annotations

import numpy as np

from valuemap.arrays import Floats
from valuemap.evaluate import Evaluation
from valuemap.map_folder import Map


def error_m(result: Map, evaluation: Evaluation) -> Floats:
    """Return the distance (labels) of every true label from its object, NaN for the others."""
    matches = evaluation.matches
    row = matches.object_of_label
    error = np.full(len(row), np.nan)
    found = row >= 0
    apart = result.labels.position_in_world_m[found] - matches.object_in_world_m[row[found]]
    if not matches.objects.has_height:
        apart -= np.outer(apart @ np.array(result.frame.up), result.frame.up)
    error[found] = np.linalg.norm(apart, axis=1)
    return error


def spread_m(result: Map) -> Floats:
    """Return the standard deviation (labels) of each position, over all directions: the root of the trace."""
    trace = result.labels.stated_covariance_m2[:, [0, 3, 5]].sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(trace, 0.0)))
