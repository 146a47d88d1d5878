"""Stage 3: labels of different clusters that stand for one object become one (section III-C of the paper)."""

from __future__ import annotations

import valuemap._core as _core
from valuemap.cameras import Rays
from valuemap.config import MergeConfig
from valuemap.tables.candidates import Candidates


def merge_clusters(rays: Rays, candidates: Candidates, config: MergeConfig) -> Candidates:
    """Merge candidates of one class and of different clusters closer than `merge_radius_m`, the closest pair first.

    Positions are refined over the union of the voters. Candidates of one cluster were told apart there and stay
    apart. The result is ordered by first voter and no longer of clusters.
    """
    assert candidates.cluster is not None
    position, (offsets, voters) = _core.merge(
        rays.core,
        candidates.position_in_world_m,
        candidates.voter_offsets,
        candidates.voters,
        candidates.cluster,
        config.merge_radius_m,
    )
    return Candidates(position, offsets, voters)
