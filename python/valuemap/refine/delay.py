"""How late poses are, as each drive alone tells it: only where poses are right do its images agree on what they see."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from valuemap.arrays import Floats, Ints
from valuemap.config import MapConfig
from valuemap.refine.footage import Footage
from valuemap.refine.landmarks import stretches, vote_on_stretches

_STEP_S = 0.02
_DELAYS_S = _STEP_S * np.arange(-15, 16)
_LEAST_STRETCHES = 3
"""With a price of this many, above one, what a single stretch gains is no proof: its square is that of the sum."""


def delay_alone(laid: Callable[[float], Footage], segment: Ints, config: MapConfig, *, threads: int = 0) -> float:
    """Return by how many seconds all poses seem to be late: that by which most detections vote, in each drive alone.

    Late poses are off by the same along a straight at steady speed, and a drive alone does not tell. Where it turns,
    brakes or waits, they are off by more or less than before, and what it sees from there meets nowhere else.

    Stretches are voted on apart. Each is therefore one observation of how many votes a delay gains, and the gain
    exceeds what they scatter by, or it is none: the price is that of Bayes' information criterion.

    Parameters
    ----------
    laid
        Gives the footage with all poses moved on by some seconds.
    segment
        The part of its drive between two jumps (N) that each keyframe is in.
    config
        Ranges, parallax and gate as in mapping.
    threads
        Threads to work on, 0 for one a core.
    """
    footage = laid(0.0)
    stretch, gate_px = stretches(footage.drives, segment, config), gate_of_delay_px(footage, config)

    def votes(late_s: float) -> Ints:
        rays = laid(late_s).rays
        voters = vote_on_stretches(rays, stretch, config, gate_px, threads=threads).voters
        return np.bincount(stretch[rays.image_row[voters]], minlength=int(stretch.max()) + 1)

    all_votes = np.array([votes(late_s) for late_s in _DELAYS_S.tolist()])
    best, none = int(np.argmax(all_votes.sum(axis=1))), len(_DELAYS_S) // 2
    return float(_DELAYS_S[best]) if is_gain(all_votes[best] - all_votes[none]) else 0.0


def is_gain(gains: Ints) -> bool:
    """Return whether the sum of gains (N) is more than chance, where each of them is as likely a loss.

    A stretch that gains nothing is straight, and tells no delay. One alone proves none.
    """
    price = math.log(max(int(np.count_nonzero(gains)), _LEAST_STRETCHES))
    return bool(gains.sum() ** 2 > price * np.sum(gains**2))


def gate_of_delay_px(footage: Footage, config: MapConfig) -> float:
    """Return a gate as wide as what the delay that is nearest to the right one leaves where cars turn, or wider."""
    turned_px = 0.5 * _STEP_S * _turning_radps(footage.motion.forward_radps) * footage.usual_pixels_per_rad
    return max(config.vote.max_reprojection_error_px, turned_px)


def _turning_radps(rate_radps: Floats) -> float:
    """Return how fast images turn where they do: the mean rate of all that is turned."""
    rate = np.linalg.norm(rate_radps, axis=1)
    return float(np.sum(rate**2) / max(float(np.sum(rate)), 1e-9))
