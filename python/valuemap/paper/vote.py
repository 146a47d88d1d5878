"""Stage 2: hypotheses from pairs of rays, votes, and the greedy selection (Algorithm 1 of the paper)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

import valuemap._core as _core
from valuemap.cameras import Rays
from valuemap.config import VoteConfig
from valuemap.errors import SettingError
from valuemap.progress import Progress, counted, silent
from valuemap.tables.candidates import Candidates


def vote_in_clusters(
    rays: Rays,
    cluster_of_image: NDArray[np.uint32],
    config: VoteConfig,
    *,
    threads: int = 0,
    progress: Progress = silent,
) -> tuple[Candidates, dict[str, int]]:
    """Return the accepted points of all clusters, refined over their voters, and counts of pairs by outcome.

    Works on each cluster and class alone, in parallel on `threads` threads (0: one a core); the result does not
    depend on their number.

    Raises
    ------
    SettingError
        A cluster is so dense that the votes of its hypotheses, cubic in its detections, do not fit into memory.
    """
    cluster_of_ray = cluster_of_image[rays.image_row]
    clusters = max(1, len(np.unique(cluster_of_ray)))
    try:
        with counted(progress, "voting", clusters) as tell:
            position, (offsets, voters), cluster, counts = _core.vote(
                rays.core,
                cluster_of_ray,
                max_reprojection_error_px=config.max_reprojection_error_px,
                min_parallax_rad=math.radians(config.min_parallax_deg),
                min_range_m=config.nearest_m,
                max_range_m=config.farthest_m,
                min_vote_ratio=config.min_vote_ratio,
                min_votes=config.min_votes,
                threads=threads,
                progress=lambda done, total: tell(clusters * done // max(total, 1)),
            )
    except MemoryError as error:
        detections, hypotheses = error.args
        raise SettingError(
            f"a cluster of {detections} detections has {hypotheses} hypotheses: their votes do not fit into memory",
            hint="lower cluster_radius_m or max_reprojection_error_px, or raise min_parallax_deg",
        ) from error
    return Candidates(position, offsets, voters, cluster), counts
