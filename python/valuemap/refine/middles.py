"""What middles the sides of objects show, told by all objects of a map together.

A box shows the middle of what its side of an object is. Sides of one object disagree about where it is by what these
middles are off by, and by what poses are off by there. Of one object alone that cannot be told apart where passes drift
by more than middles are off. But poses are off for all that images show, and middles are each object's own: so all
sides are placed in one adjustment, and what is off by is told by the likelihood of how they disagree, all together
(restricted maximum likelihood; Patterson and Thompson 1971).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from valuemap.arrays import Bools, Floats, Ints, runs
from valuemap.refine.footage import AllImages
from valuemap.refine.images import Bundle, bundle
from valuemap.refine.poses import one_blas_thread
from valuemap.robust import Noise
from valuemap.tables import Labels, Votes

_LEAST_OBJECTS = 5
"""Fewer objects of several sides do not tell what sides show, as in the core."""
_MOST_OBJECTS = 100
"""Objects that are asked, at most about: they tell it to a twentieth, and how all disagree is one dense matrix."""
_CERTAIN = 9.0
"""Middles are there where twice the logarithm of the likelihood gains more: chance has it in one case of a thousand."""
_LEAST_GAIN = 2.0
"""Covariances reckon with middles where it gains more: what one parameter gains by chance (Akaike)."""
_ODD_CHANCE = 0.0027
"""Objects that disagree by what chance has in fewer cases, three standard deviations, given all others, are two."""
_MOST_SHARE = 0.5
"""What a side shows is a part of its thing, so its middle is no farther off than this share of how large that is."""
_LEAST_SHARE_OF_MOST = 1e-3
"""Middles are sought down to this share of the most: less is an error of the detector, if it is one."""
_VALUES = 60
"""Values between that and the most, at which the likelihood is compared: they differ by an eighth."""
_UNKNOWN = 10.0
"""What is known to so many times the most that middles are off by says nothing of them."""
_ROUNDS = 10
"""Rounds in which objects are taken in and left out, at most: three or four do."""


@dataclass(frozen=True)
class Middles:
    """What the middles that sides show are off by, m, each axis, and whether that is beyond doubt."""

    off_m: float
    is_certain: bool


def middles(images: AllImages, labels: Labels, votes: Votes, noise: Noise) -> Middles | None:
    """Return what middles are off by; None where nothing tells that they are.

    `noise` is that of the map of `labels` and `votes`. What is not known well, as depth is, says little of middles.
    """
    size_m = np.maximum(labels.object_width_m, labels.object_height_m)
    size_m = size_m[size_m > 0.0]
    if not len(size_m):  # Middles are those of boxes.
        return None
    most_m = _MOST_SHARE * float(np.median(size_m))
    # One vote does not say where it would put an object. So sides are placed with middles that are off by the most.
    # That is taken out of what is known of them then.
    told = bundle(images, labels, votes, replace(noise, side_m=most_m))
    told = replace(told, ties=replace(told.ties, total=np.inf))
    sides = _asked(_sides(told))
    if len(sides) < _LEAST_OBJECTS:
        return None
    point_m, covariance_m2 = told.placed(np.concatenate(sides)[None])
    with one_blas_thread():
        contrasts = Contrasts.of_sides([point_m[things] for things in sides], covariance_m2[0])
        return contrasts.untied(most_m).middles(most_m)


def _sides(told: Bundle) -> list[Ints]:
    """Return the things that are sides, label by label, of those labels that have several."""
    things = np.argsort(told.label, kind="stable")
    return [things for things in runs(things, told.label[things]) if len(things) > 1]


def _asked(sides: list[Ints]) -> list[Ints]:
    """Return about as many objects as are asked, evenly spread."""
    return sides[:: -(-len(sides) // _MOST_OBJECTS)] if sides else sides


def _best_half(chances: Floats) -> Bools:
    """Return which objects are the half that agrees best, or as many as tell what sides show."""
    count = max(-(-len(chances) // 2), _LEAST_OBJECTS)
    return np.asarray(chances >= np.sort(chances)[-count])


@dataclass(frozen=True, eq=False)
class Contrasts:
    """By what the sides of objects disagree: orthonormal contrasts (N), m, with their covariance (N, N), m².

    `of` (N) is the object of each. Middles that are off by s each axis add s² to the variance of each.
    """

    apart_m: Floats
    covariance_m2: Floats
    of: Ints

    @classmethod
    def of_sides(cls, point_m: list[Floats], covariance_m2: Floats) -> Contrasts:
        """Return those of the sides (M, 3) of objects, that are known together as said, in their order."""
        # Beside the first side: of large numbers little would be left.
        by_object = [np.kron(scipy.linalg.null_space(np.ones((1, len(points)))).T, np.eye(3)) for points in point_m]
        apart = [by @ (points - points[0]).ravel() for by, points in zip(by_object, point_m, strict=True)]
        by = scipy.linalg.block_diag(*by_object)
        return cls(
            np.concatenate(apart), by @ covariance_m2 @ by.T, np.repeat(np.arange(len(apart)), list(map(len, apart)))
        )

    def untied(self, tie_m: float) -> Contrasts:
        """Return what these are without middles that were thought to be off by `tie_m`.

        What is not known otherwise is known to ten times of that, so that it says nothing of less.
        """
        precision = np.linalg.inv(self.covariance_m2)
        pull = precision @ self.apart_m
        own, axes = scipy.linalg.eigh(precision - np.eye(len(pull)) / tie_m**2)
        covariance_m2 = (axes / np.maximum(own, 1.0 / (_UNKNOWN * tie_m) ** 2)) @ axes.T
        return replace(self, apart_m=covariance_m2 @ pull, covariance_m2=covariance_m2)

    def middles(self, most_m: float) -> Middles | None:
        """Return what middles are off by, m, less than the most; None where nothing tells that they are.

        Objects that disagree by more than middles and poses explain, given all others, are left out, and the others
        tell it again.
        """
        values_m = most_m * np.geomspace(_LEAST_SHARE_OF_MOST, 1.0, _VALUES)
        everyone = np.ones(self.of[-1] + 1, np.bool_)
        # Objects that are two hide each other where all tell what is usual: the half that agrees best begins.
        is_one = _best_half(self._chances(everyone, self._likeliest(everyone, values_m)[0]))
        likeliest_m, gain = self._as_of_all(is_one)._likeliest(is_one, values_m)
        for _ in range(_ROUNDS):
            before, is_one = is_one, self._chances(is_one, likeliest_m) > _ODD_CHANCE
            if is_one.sum() < _LEAST_OBJECTS:
                return None
            if np.array_equal(is_one, before):
                break
            likeliest_m, gain = self._likeliest(is_one, values_m)
        # Sides that disagree by more than things are large are those of several things.
        if gain <= _LEAST_GAIN or likeliest_m >= most_m:
            return None
        return Middles(likeliest_m, is_certain=gain > _CERTAIN)

    def _as_of_all(self, is_best: Bools) -> Contrasts:
        """Return contrasts of which those of the objects that agree best are as large as all would be.

        A share of squares from the least on has a mean below that of all, by a factor that is known for a Gaussian
        (Croux and Haesbroeck 1999, of the minimum covariance determinant).
        """
        share, freedom = is_best.mean(), np.bincount(self.of)
        if share == 1.0:
            return self
        factor = share / scipy.special.chdtr(freedom + 2, scipy.special.chdtri(freedom, 1.0 - share))
        return replace(self, apart_m=self.apart_m * np.sqrt(factor)[self.of])

    def _likeliest(self, is_one: Bools, values_m: Floats) -> tuple[float, float]:
        """Return which value is likeliest for some of the objects, and twice what its log-likelihood gains."""
        rows = np.flatnonzero(is_one[self.of])
        variance, axes = scipy.linalg.eigh(self.covariance_m2[np.ix_(rows, rows)])
        square = (axes.T @ self.apart_m[rows]) ** 2
        total = np.maximum(variance, 0.0) + values_m[:, None] ** 2
        twice_ln = -(np.log(total) + square / total).sum(axis=1)
        best = int(np.argmax(twice_ln))
        return float(values_m[best]), float(twice_ln[best] - twice_ln[0])

    def _chances(self, is_one: Bools, middles_m: float) -> Floats:
        """Return how probable it is that an object disagrees by so much or more, given the others of some, of each."""
        covariance_m2 = self.covariance_m2 + middles_m**2 * np.eye(len(self.of))
        rows = np.flatnonzero(is_one[self.of])
        precision = np.linalg.inv(covariance_m2[np.ix_(rows, rows)])
        pull = precision @ self.apart_m[rows]
        chances = np.empty(len(is_one))
        for one, is_among in enumerate(is_one):
            if is_among:  # The block of the inverse is the inverse of what is known given the others.
                own = np.flatnonzero(self.of[rows] == one)
                square = pull[own] @ np.linalg.solve(precision[np.ix_(own, own)], pull[own])
            else:
                own = np.flatnonzero(self.of == one)
                across = covariance_m2[np.ix_(own, rows)]
                off_m = self.apart_m[own] - across @ pull
                known_m2 = covariance_m2[np.ix_(own, own)] - across @ precision @ across.T
                square = off_m @ np.linalg.solve(known_m2, off_m)
            chances[one] = scipy.special.chdtrc(len(own), square)
        return chances
