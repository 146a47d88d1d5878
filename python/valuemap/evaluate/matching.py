"""Labels and true objects, matched one to one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.dataset import Frame
from valuemap.errors import SettingError
from valuemap.evaluate.figures import is_number
from valuemap.evaluate.truth import TrueObjects
from valuemap.tables import Categories, Labels

LABEL_OUTCOMES = ("duplicate", "false", "true", "gone")
OBJECT_OUTCOMES = ("found", "missed", "not recoverable")
_LARGEST_RADIUS_M = 1e7
"""The Earth is no wider: and the squares of what is far larger are no numbers."""


@dataclass(frozen=True, eq=False)
class Matches:
    """What became of every label and every true object; labels that are gone were left out.

    `object_of_label` (labels) holds the row of the matched object or -1, `label_of_object` (objects) the row
    of the matched label or -1; the outcomes are texts of LABEL_OUTCOMES and OBJECT_OUTCOMES. `is_split_object`
    (objects): matched, and another label within the radius is not; `is_merged_label` (labels): matched, and another
    object within the radius is not.
    """

    objects: TrueObjects
    object_of_label: Ints
    label_of_object: Ints
    label_outcome: Categories
    object_outcome: Categories
    is_split_object: Bools
    is_merged_label: Bools

    def among_all(self, is_counted: Bools) -> Matches:
        """Return the same matches by the rows of all labels, of which those that are counted were matched."""
        rows, count = np.flatnonzero(is_counted), len(is_counted)
        object_of_label = np.full(count, -1, np.int64)
        object_of_label[rows] = self.object_of_label
        label_of_object = self.label_of_object.copy()
        is_found = label_of_object >= 0
        label_of_object[is_found] = rows[label_of_object[is_found]]
        label_outcome = np.full(count, LABEL_OUTCOMES.index("gone"), np.int32)
        label_outcome[rows] = self.label_outcome.codes
        is_merged = np.zeros(count, np.bool_)
        is_merged[rows] = self.is_merged_label
        return replace(
            self,
            object_of_label=object_of_label,
            label_of_object=label_of_object,
            label_outcome=Categories(label_outcome, LABEL_OUTCOMES),
            is_merged_label=is_merged,
        )

    @property
    def object_in_world_m(self) -> Floats:
        """Positions (objects, 3) of the true objects in metres in the frame of the map."""
        return self.objects.position_in_world_m


def check_radius(radius_m: float) -> None:
    """Refuse a radius, in metres, within which a label can be an object, that is no length (`SettingError`)."""
    if not (is_number(radius_m) and 0.0 < radius_m <= _LARGEST_RADIUS_M):
        told = f"radius: expected above 0 m and up to {_LARGEST_RADIUS_M:g} m, found {radius_m!r}"
        raise SettingError(told, hint="the default is 2 m")


def match_labels(labels: Labels, objects: TrueObjects, frame: Frame, *, radius_m: float = 2.0) -> Matches:
    """Match labels with true objects one to one: most matches first, then the smallest sum of distances.

    Raises
    ------
    SettingError
        The radius is not a length.
    """
    check_radius(radius_m)
    label, true_object, distance_m = _pairs_within(labels, objects, frame, radius_m)
    chosen = _best_assignment(label, true_object, distance_m, radius_m)
    object_of_label = np.full(len(labels), -1, dtype=np.int64)
    label_of_object = np.full(len(objects), -1, dtype=np.int64)
    object_of_label[label[chosen]] = true_object[chosen]
    label_of_object[true_object[chosen]] = label[chosen]

    is_near = np.zeros(len(labels), dtype=np.bool_)
    is_near[label] = True  # Were its neighbour free, it would be matched with it.
    # Of a pair within the radius at least one is matched: else the pair would be.
    is_split, is_merged = np.zeros(len(objects), np.bool_), np.zeros(len(labels), np.bool_)
    is_split[true_object[object_of_label[label] < 0]] = True
    is_merged[label[label_of_object[true_object] < 0]] = True
    label_outcome = np.select([object_of_label >= 0, is_near], [2, 0], default=1)
    object_outcome = np.select([label_of_object >= 0, objects.counts_in_recall], [0, 1], default=2)
    return Matches(
        objects=objects,
        object_of_label=object_of_label,
        label_of_object=label_of_object,
        label_outcome=Categories(label_outcome.astype(np.int32), LABEL_OUTCOMES),
        object_outcome=Categories(object_outcome.astype(np.int32), OBJECT_OUTCOMES),
        is_split_object=is_split,
        is_merged_label=is_merged,
    )


def _pairs_within(labels: Labels, objects: TrueObjects, frame: Frame, radius_m: float) -> tuple[Ints, Ints, Floats]:
    """Return label row, object row and distance (m) of every pair of one class within the radius."""
    from scipy.spatial import KDTree  # Slow to import, and only evaluation needs it.

    label_points, object_points = labels.position_in_world_m, objects.position_in_world_m
    if not objects.has_height:
        along_ground = np.eye(3) - np.outer(frame.up, frame.up)
        label_points, object_points = label_points @ along_ground, object_points @ along_ground
    if len(labels) == 0 or len(objects) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    pairs = KDTree(label_points).sparse_distance_matrix(KDTree(object_points), radius_m, output_type="ndarray")
    label, true_object, distance_m = pairs["i"], pairs["j"], pairs["v"]
    if objects.class_name is not None:
        code_in_truth = np.array([objects.class_name.code_of(name) for name in labels.class_name.names], np.int64)
        same = code_in_truth[labels.class_name.codes[label]] == objects.class_name.codes[true_object]
        label, true_object, distance_m = label[same], true_object[same], distance_m[same]
    order = np.lexsort((true_object, label))  # The tree promises no order.
    return label[order], true_object[order], distance_m[order]


def _best_assignment(label: Ints, true_object: Ints, distance_m: Floats, radius_m: float) -> Ints:
    """Return the pairs (rows) that make the most matches and, of such choices, the smallest sum of distances.

    Every label may also stay alone at a cost above any sum of distances, so that the cheapest assignment of
    all labels has as many matches as possible. One sparse problem for all: its size follows the pairs.
    """
    from scipy.sparse import csr_array  # Slow to import, and only evaluation needs it.
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    # A pair whose label and object have no other is matched in any case.
    is_alone = (np.bincount(label)[label] == 1) & (np.bincount(true_object)[true_object] == 1)
    alone, rest = np.flatnonzero(is_alone), np.flatnonzero(~is_alone)
    if len(rest) == 0:
        return alone
    labels, label = np.unique(label[rest], return_inverse=True)
    objects, true_object = np.unique(true_object[rest], return_inverse=True)
    # The 1 in all costs keeps zeros, which would be no edges, out of the sparse matrix.
    alone_cost = 1.0 + radius_m * (len(objects) + 1)
    row = np.concatenate([label, np.arange(len(labels))])
    column = np.concatenate([true_object, len(objects) + np.arange(len(labels))])
    cost = np.concatenate([1.0 + distance_m[rest], np.full(len(labels), alone_cost)])
    graph = csr_array((cost, (row, column)), shape=(len(labels), len(objects) + len(labels)))
    matched_object = np.empty(len(labels), np.int64)
    rows, columns = min_weight_full_bipartite_matching(graph)
    matched_object[rows] = columns
    return np.concatenate([alone, rest[matched_object[label] == true_object]])
