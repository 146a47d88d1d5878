"""Which of two passes that are apart is the one that is off."""

from __future__ import annotations

import numpy as np
from scipy import stats
from scipy.spatial import cKDTree

from valuemap.arrays import Floats
from valuemap.check.agreement import chance_of_majority
from valuemap.check.fault import (
    AGAINST,
    LEAST_CHANCE,
    View,
)
from valuemap.check.meeting import Meeting
from valuemap.check.quality import flattened


def which_of_two(one: str, other: str, apart: str) -> str:
    """Return in one sentence that two passes are apart, and that it is not known which of them is off."""
    return f"Passes {one} and {other} are {apart}, and nothing tells which of the two is off."


def which_is_off(view: View, meeting: Meeting, mine: tuple[int, Floats], theirs: tuple[int, Floats]) -> bool | None:
    """Return whether the first of two passes is the one that is off, None where neither truth nor poses' sigmas say so.

    Each is given as its code and all points (P, 3) with its own as they would be were it the one that is off.
    """
    by_truth = _by_truth(view, meeting, mine, theirs)
    return _by_sigmas(view, meeting, mine, theirs) if by_truth is None else by_truth


def _by_truth(view: View, meeting: Meeting, mine: tuple[int, Floats], theirs: tuple[int, Floats]) -> bool | None:
    """Count the true objects that either pass sees where they are, as given or moved (a sign test)."""
    truth = view.dataset.truth
    if truth is None or not len(truth):
        return None
    middle = meeting.middle_in_world_m
    objects = flattened(truth.position_in_world_m, truth, view)
    says_mine = votes = 0
    for is_mine, (code, moved) in ((True, mine), (False, theirs)):
        own = meeting.pass_of_point == code
        given, there = (flattened(each[own] + middle, truth, view) for each in (meeting.point, moved))
        near_m = float(np.median(np.linalg.norm(there - given, axis=1))) / 2.0
        given_m, there_m = (np.asarray(cKDTree(each).query(objects)[0]) for each in (given, there))
        is_near = (np.minimum(given_m, there_m) < near_m) & (given_m != there_m)
        votes += int(is_near.sum())
        says_mine += int((((there_m < given_m) == is_mine) & is_near).sum())
    for says, is_mine in ((says_mine, True), (votes - says_mine, False)):
        if 2.0 * chance_of_majority(says, votes) < LEAST_CHANCE:
            return is_mine
    return None


def _by_sigmas(view: View, meeting: Meeting, mine: tuple[int, Floats], theirs: tuple[int, Floats]) -> bool | None:
    """See whether one pass states errors as large as that, and the other states that it has none."""
    sigma_m = view.dataset.images.position_sigma_m
    if sigma_m is None:
        return None
    likely = []
    for code, moved in (mine, theirs):
        own = meeting.pass_of_point == code
        off_m = float(np.median(np.linalg.norm((moved - meeting.point)[own], axis=1)))
        stated_m = sigma_m[view.dataset.images.pass_id.codes == code]
        if not np.any(np.isfinite(stated_m)):
            return None
        stated = float(np.nanmedian(stated_m))
        likely.append(0.0 if stated <= 0.0 else float(stats.chi2.sf((off_m / stated) ** 2, 3)))
    for (one, another), is_mine in ((likely, True), (likely[::-1], False)):
        if one > AGAINST and another < LEAST_CHANCE:
            return is_mine
    return None
