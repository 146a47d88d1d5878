"""Points that may become labels, between the steps that make a map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from valuemap.arrays import Floats, Ints, rows_in_runs
from valuemap.tables.column import taken


@dataclass(frozen=True, eq=False)
class Candidates:
    """Points with the rays that support them: what voting finds and merging makes into labels.

    `position_in_world_m` (N, 3); the voters of candidate i are the rows `voters[voter_offsets[i] :
    voter_offsets[i + 1]]` of the detections, ascending. `cluster` (N) is where it was found (paper); `covariance_m2`
    (N, 3, 3), the probability of `existence` (N), the number of images `expected` to see it (N) and the code of its
    class `class_code` (N) are what the robust method adds; without, voters are all of one class.
    """

    position_in_world_m: Floats
    voter_offsets: Ints
    voters: NDArray[np.uint32]
    cluster: NDArray[np.uint32] | None = None
    covariance_m2: Floats | None = None
    existence: Floats | None = None
    expected: Ints | None = None
    class_code: Ints | None = None

    def __len__(self) -> int:
        return len(self.position_in_world_m)

    def take(self, rows: Ints) -> Candidates:
        """Return the candidates given by indices, with their voters."""
        count = np.diff(self.voter_offsets)[rows]
        offsets = np.concatenate([[0], np.cumsum(count)])
        voters = self.voters[rows_in_runs(self.voter_offsets[rows], count)]
        names = ("cluster", "covariance_m2", "existence", "expected", "class_code")
        columns = {name: taken(getattr(self, name), rows) for name in names}
        return Candidates(self.position_in_world_m[rows], offsets, voters, **columns)

    def row_of_voter(self) -> Ints:
        """Return the candidate (row) that each of the voters supports."""
        return np.repeat(np.arange(len(self)), np.diff(self.voter_offsets))
