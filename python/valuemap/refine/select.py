"""Which errors the data prove: each kind of them pays for itself, or is exactly zero.

Drift as large as it is found to be takes part in every fit, so that what a drive's poses do anyway is not taken for a
fault of them. What has a common cause (a camera) is tried before what each drive has for itself. A parameter pays if
its squared ratio to its deviation exceeds the price of Bayes' information criterion, and of having looked at so many;
and if it is larger than drift. Where a kind of error is proven of some drives, others have it too, but no more of it
than drift: a spike and a slab, with the spike as wide as drift (George & McCulloch 1993). At the end all that stays is
fitted to one half of the objects, and must make the rays of the other half meet better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from valuemap.arrays import Bools, Floats, Ints
from valuemap.refine.adjust import Adjustment, Chain, Scales, adjust, triangulate
from valuemap.refine.alias import BEYOND_DRIFT, agreed_shift
from valuemap.refine.estimate import WIDE, Estimate, everything, seen_by, segments_of
from valuemap.refine.footage import Footage
from valuemap.refine.jumps import Links
from valuemap.refine.residuals import (
    CAMERA_DELAY,
    CAMERA_MOUNT,
    DELAY,
    FOCAL,
    MOUNT,
    OFFSET,
    Observations,
    State,
    cost,
)
from valuemap.refine.ties import tie
from valuemap.refine.tracks import unresolved_share

_LEAST_DRIFT, _LEAST_DRIFT_RAD = 0.02, math.radians(0.02)
"""Drift is thought to be no less than this, m and rad, each axis."""
_LEAST_FOCAL = 0.003
"""What is less than this share of a focal length is no error of it."""
_SIGMA_FOCAL = 0.01
"""Focal lengths are known to this share where they come with a calibration: what objects tell less well mends none."""
_REFIT, _ANEW = (1.5, 1.0, 1.0, 1.0), (1.0, 1.0, 1.0)
_DECISIVE = 2.0 * math.log(100.0)
"""Held-out objects must be likelier by more than this beyond the price of parameters: more than a hundred to one is
what Jeffreys (1961, appendix B) calls decisive."""
LEAST_CHANCE = 0.01
"""What is less likely luck than this, by how much the gains of objects differ, is to be looked at."""
_DOUBTFUL = 0.5
"""The same where a fault touches some objects only: what these gain is what gains differ by then. Whether all
detections are likelier is asked in any case."""
_OF_ALL_OBJECTS = (FOCAL, CAMERA_MOUNT, MOUNT)
"""Kinds that touch all that a camera or drive shows. A place or a time that is off shows where drives meet, or turn."""
_FEW_GAINS = 8
"""How fewer gains are distributed nobody knows: their ranks alone tell whether they are luck."""
_MOST_UNRESOLVED = 0.23
"""Where drives disagree about more than this share of what they see, they could not be laid onto each other."""
_LEAST_OF_DRIVE = 3
"""A drive that sees an object less often does not share it."""
_LEAST_OF_SEGMENT = 3
"""A segment that shares fewer objects is nowhere else than others, or where the drive that it goes on from is. Of fewer
that drives share all in all, none can be held out."""
_IN_ALL_DRIVES, _IN_EACH_DRIVE = (OFFSET, FOCAL, CAMERA_MOUNT, CAMERA_DELAY), (MOUNT, DELAY)
"""Kinds that each camera has in all drives, with offsets; and those that it has in each drive for itself."""
_OF_MANY = (OFFSET, MOUNT, DELAY)
"""Kinds that each drive has for itself."""
_LEAST_OF_PART = 2
"""A drive or camera that shares fewer objects is turned, delayed and focused as given; one tells where a segment is."""
_PLAUSIBLE = 3.0
"""What is more than so many deviations of what is thought possible is something else."""


@dataclass(frozen=True, eq=False)
class Selected:
    """What stays: the state, in which all else is zero; and how much better held-out objects are explained.

    `deviation` (by kind, as the constants) are standard deviations; `price` is what parameters gain by being free,
    `chance` the probability that the gain on `held_out` objects is luck.
    """

    state: State
    active: tuple[Bools, ...]
    deviation: tuple[Floats, ...]
    gain: float
    price: float
    chance: float
    held_out: int

    @property
    def is_proven(self) -> bool:
        """Whether the gain is worth a comparison of all detections."""
        touches_all = any(self.active[kind].any() for kind in _OF_ALL_OBJECTS)
        return self.gain > self.price + _DECISIVE and self.chance < (LEAST_CHANCE if touches_all else _DOUBTFUL)

    @property
    def parameters(self) -> int:
        """How many parameters are not zero."""
        return sum(int(np.count_nonzero(constants)) for constants in self.state.constants)


def select(footage: Footage, found: Estimate) -> Selected | None:
    """Return what pays, None where nothing does."""
    shared = _shared(footage, found)
    if shared is None or unresolved_share(seen_by(footage, found), found.state, found.class_code) > _MOST_UNRESOLVED:
        return None
    found = shared
    seen = seen_by(footage, found)
    ties = tie(footage, found.segments, seen)
    views = replace(seen.views, segment=ties.segment[seen.views.segment], vehicle=ties.vehicle[seen.views.vehicle])
    seen = replace(seen, views=views)
    chain, things = footage.chain, len(found.class_code)
    linked = found.links.groups(len(found.segments))
    free = _told(seen, everything(footage, found.segments), linked)
    narrow = tuple(np.zeros_like(flags) for flags in free)
    objects = _objects_of(linked[seen.segment], seen.thing, len(found.segments))[linked]
    narrow[OFFSET][objects < _LEAST_OF_SEGMENT] = True
    trial = Trial(seen, chain, _scales(footage, found), things, found.links, linked, bound=narrow)
    state, active, narrow = _what_pays(trial, free, found.state)
    if not any(flags.any() for flags in active):
        return None
    scales = trial.narrowed(narrow)
    found = replace(found, links=found.links.without(narrow[OFFSET][:, 0] | ~active[OFFSET][:, 0]))
    proof = _Proof.of(Adjustment(seen, chain, scales, active, things, found.links), state)
    rest = (np.zeros_like(active[OFFSET]), *active[OFFSET + 1 :])
    if active[OFFSET].any() and any(flags.any() for flags in rest):
        # What offsets make worse is not paid for by what others make better.
        alone = Adjustment(seen, chain, scales, rest, things, Links.none())
        without = _Proof.of(alone, state.with_offset(np.zeros_like(state.constants[OFFSET])))
        proof = max(proof, without, key=lambda one: one.gain - one.price)
    if proof.gain <= proof.price:
        return None
    state = proof.state
    values = (state.constants, proof.problem.active, proof.deviation())
    constants, active, deviation = (ties.spread(of_kinds) for of_kinds in values)
    constants = (_about_the_mean(footage, found, constants[OFFSET], active[OFFSET]), *constants[1:])
    state = replace(state, constants=constants)
    return Selected(state, active, deviation, proof.gain, proof.price, proof.chance, proof.held_out)


@dataclass(frozen=True, eq=False)
class _Proof:
    """A fit of the constants that are free in a problem, and what objects gain that had no part in it (`Selected`)."""

    problem: Adjustment
    state: State
    gain: float
    price: float
    chance: float
    held_out: int

    @classmethod
    def of(cls, problem: Adjustment, state: State) -> _Proof:
        """Fit from a state."""
        state = adjust(problem, state, tolerances=_REFIT, with_variance=True)
        gain = _gain_of_held_out(problem, state)
        return cls(problem, state, float(gain.sum()), price_of(problem, state), chance_of_gain(gain), len(gain))

    def deviation(self) -> tuple[Floats, ...]:
        """Return the standard deviations of the constants by kind, 0 where they are not free."""
        assert self.state.covariance is not None
        sigma = np.append(np.sqrt(np.diag(self.state.covariance)), 0.0)
        first = 3 * self.problem.things
        return tuple(sigma[np.where(index >= 0, index - first, -1)] for index in self.problem.column_of)


def _what_pays(
    trial: Trial, free: tuple[Bools, ...], state: State
) -> tuple[State, tuple[Bools, ...], tuple[Bools, ...]]:
    """Return which of the constants that are `free` pay, which of them are narrow, and the state with them."""
    nothing = tuple(np.zeros_like(flags) for flags in free)
    # What each camera has in all drives, and offsets, first; what it has in each drive where that does not do.
    active = _offered(nothing, free, _IN_ALL_DRIVES)
    state, active, narrow = trial.prune(active, trial.bound, state, ((),))
    # What a straight drive is off along itself is as well a delay: it must pay beside what has been proven without it.
    fixed = (_IN_ALL_DRIVES, (CAMERA_MOUNT, CAMERA_DELAY), ())
    return trial.prune(_offered(active, free, _IN_EACH_DRIVE), narrow, state, fixed)


def _offered(active: tuple[Bools, ...], free: tuple[Bools, ...], kinds: tuple[int, ...]) -> tuple[Bools, ...]:
    """Return what is active with all that is free of some kinds."""
    return tuple(flags | free[kind] if kind in kinds else flags for kind, flags in enumerate(active))


def price_of(problem: Adjustment, state: State) -> float:
    """Return what constants cost that are free: minus twice the logarithm of their Occam factor (MacKay 2003, ch. 28).

    It is how improbable they were before anything was observed, and how much narrower they are now. Offsets that are
    all alike are as free as they were, and cost nothing; those that a jump ties to each other cost once. `state` is the
    solution, with the covariance of its constants.
    """
    assert state.covariance is not None
    prior = _prior(problem.scales, problem.active)
    improbable = float(np.sum(prior * _values(state, problem.active) ** 2))
    thought = np.diag(prior)
    column = problem.links.columns(problem.column_of[OFFSET]) - 3 * problem.things
    np.add.at(thought, (column[:, :, None], column[:, None, :]), problem.links.blocks())
    return float(improbable - np.linalg.slogdet(thought)[1] - np.linalg.slogdet(state.covariance)[1])


def _prior(scales: Scales, active: tuple[Bools, ...]) -> Floats:
    """Return the information (C) on each of the constants that are active, before anything is observed."""
    sigmas = (np.broadcast_to(s, flags.shape)[flags] for s, flags in zip(scales.constant, active, strict=True))
    return np.asarray(np.concatenate(list(sigmas)) ** -2.0)


def _values(state: State, active: tuple[Bools, ...]) -> Floats:
    """Return the constants that are active (C)."""
    return np.concatenate([values[flags] for values, flags in zip(state.constants, active, strict=True)])


def _about_the_mean(footage: Footage, found: Estimate, offset: Floats, active: Bools) -> Floats:
    """Return the offsets (L, 3) against their mean over all drives, weighted by what they claim.

    Segments that stay as they are would else be taken for the truth, however little they tell of the place of the
    others: the absolute position is the mean of all drives.
    """
    if not active.any():
        return offset
    segment = segments_of(footage, found.segments)
    drive = footage.drives.pass_code
    mean = np.stack([np.bincount(drive, weights=offset[segment, i]) / np.bincount(drive) for i in range(3)], axis=1)
    sigma = np.full(len(mean), np.nan)
    claimed = footage.dataset.images.position_sigma_m
    if claimed is not None:
        for number in range(len(mean)):
            of_drive = claimed[(drive == number) & np.isfinite(claimed)]
            sigma[number] = np.median(of_drive) if len(of_drive) else np.nan
    usual = float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else 1.0
    weight = np.nan_to_num(sigma, nan=usual) ** -2.0
    return np.asarray(offset - weight @ mean / weight.sum())


def _shared(footage: Footage, found: Estimate) -> Estimate | None:
    """Return what several drives see, if there are several, None where that is too little.

    What one of several sees alone explains any offset and any jump of it.
    """
    drive = footage.drives.pass_code[footage.rays.image_row[found.detection]]
    pairs, votes = np.unique(np.stack([found.thing, drive]), axis=1, return_counts=True)
    drives = np.bincount(pairs[0, votes >= _LEAST_OF_DRIVE], minlength=len(found.class_code))
    kept = drives >= min(2, footage.drives.count)
    if int(kept.sum()) < _LEAST_OF_SEGMENT:
        return None
    number = np.cumsum(kept) - 1
    stays = kept[found.thing]
    return replace(
        found,
        detection=found.detection[stays],
        thing=number[found.thing[stays]],
        class_code=found.class_code[kept],
        size_m=found.size_m[kept],
        state=replace(found.state, point_in_world_m=found.state.point_in_world_m[kept]),
    )


def _told(seen: Observations, free: tuple[Bools, ...], linked: Ints) -> tuple[Bools, ...]:
    """Return which of the constants enough objects tell anything of; segments that are `linked` (L) tell each other."""
    told = []
    parts = (linked[seen.segment], seen.vehicle, seen.vehicle, seen.camera, seen.camera, seen.camera)
    for kind, (flags, of) in enumerate(zip(free, parts, strict=True)):
        objects = _objects_of(of, seen.thing, len(flags))
        objects = objects[linked] if kind == OFFSET else objects
        told.append(flags & (objects >= (1 if kind == OFFSET else _LEAST_OF_PART))[:, None])
    return tuple(told)


def _objects_of(part: Ints, thing: Ints, count: int) -> Ints:
    """Return how many objects each part sees."""
    return np.bincount(np.unique(np.stack([part, thing]), axis=1)[0], minlength=count)


def _scales(footage: Footage, found: Estimate) -> Scales:
    """Return priors with a drift as large as what is found of it, and offsets as claimed where they are."""
    return replace(
        found.scales,
        drift_m=max(found.noise.drift_m, _LEAST_DRIFT),
        drift_rad=max(found.noise.drift_rad, _LEAST_DRIFT_RAD),
        constant=(
            _offset_sigma(footage, found)[:, None],
            *WIDE.constant[1:FOCAL],
            _SIGMA_FOCAL,
            *WIDE.constant[FOCAL + 1 :],
        ),
    )


def _offset_sigma(footage: Footage, found: Estimate) -> Floats:
    """Return the deviation (L) of the offset of each segment: wide, and as its images' claims are to each other."""
    claimed = footage.dataset.images.position_sigma_m
    sigma = np.full(len(found.segments), float(WIDE.constant[OFFSET]))
    if claimed is None or not np.isfinite(claimed).any():
        return sigma
    segment = segments_of(footage, found.segments)
    usual = float(np.nanmedian(claimed))
    for number in range(len(sigma)):
        of_segment = claimed[segment == number]
        if np.isfinite(of_segment).any():
            sigma[number] *= float(np.nanmedian(of_segment)) / usual
    return sigma


@dataclass(frozen=True, eq=False)
class Trial:
    """What parameters are tried on: observations of `things` objects, and what is thought of errors a priori.

    Segments that are `linked` (L) by jumps that trajectories prove are wide if one of them pays: which of them are as
    far off as usual, nobody knows. `bound` are parameters (by kind) that are narrow whatever they would explain.
    """

    seen: Observations
    chain: Chain
    scales: Scales
    things: int
    links: Links
    linked: Ints
    bound: tuple[Bools, ...]

    def smallest(self) -> dict[int, float]:
        """Return by kind what is no more than drift is."""
        speed = max(float(np.median(np.linalg.norm(self.seen.views.forward_mps, axis=1)[self.seen.image])), 1e-9)
        of_place, of_turn = self.scales.drift_m, self.scales.drift_rad
        return {
            OFFSET: of_place,
            MOUNT: of_turn,
            CAMERA_MOUNT: of_turn,
            DELAY: of_place / speed,
            CAMERA_DELAY: of_place / speed,
            FOCAL: _LEAST_FOCAL / BEYOND_DRIFT,
        }

    def narrowed(self, narrow: tuple[Bools, ...]) -> Scales:
        """Return the scales with those of some parameters as narrow as drift."""
        wide, small = self.scales.constant, self.smallest()
        sigmas = (np.where(flags, np.minimum(small[k], wide[k]), wide[k]) for k, flags in enumerate(narrow))
        return replace(self.scales, constant=tuple(sigmas))

    def prune(
        self, active: tuple[Bools, ...], narrow: tuple[Bools, ...], state: State, fixed: tuple[tuple[int, ...], ...]
    ) -> tuple[State, tuple[Bools, ...], tuple[Bools, ...]]:
        """Drop whole groups of parameters of which none pays, the poorest first; then narrow those that do not pay.

        What does not pay of a camera is dropped too. Kinds that are `fixed` are not judged, at first those of the first
        of these, then those of the next. What the others are without a group is told by the normal equations; what is
        left then is fitted and judged anew. What is narrow and would pay, now that others are narrow, is widened again,
        once for each that is fixed.
        """
        equations: EquationsOfConstants | None = None
        for kinds in fixed:
            tolerances: tuple[float, ...] = _REFIT
            settled = tuple(flags.copy() for flags in self.bound)
            while True:
                if equations is None:
                    problem = Adjustment(self.seen, self.chain, self.narrowed(narrow), active, self.things, self.links)
                    state = adjust(problem, state, tolerances=tolerances, with_variance=True)
                    equations = EquationsOfConstants.at(problem, state)
                left, thin = self._judged(equations, active, narrow, kinds, settled)
                if _is_same((*left, *thin), (*active, *narrow)):
                    break
                # What is dropped may be explained by what is left, which is far from where it was then.
                state = replace(state, constants=equations.solved(left, self.narrowed(thin)).constants)
                active, narrow, tolerances, equations = left, thin, _ANEW, None
        return self._regauged(state, active[OFFSET], narrow[OFFSET]), active, narrow

    def _judged(
        self,
        equations: EquationsOfConstants,
        active: tuple[Bools, ...],
        narrow: tuple[Bools, ...],
        fixed: tuple[int, ...],
        settled: tuple[Bools, ...],
    ) -> tuple[tuple[Bools, ...], tuple[Bools, ...]]:
        """Return what stays of parameters, and which of them are narrow, once all that is left pays.

        What is widened is marked in `settled`: what is narrow and marked there stays so.
        """
        while True:
            fit = equations.solved(active, self.narrowed(narrow))
            worth = self._worth(fit, active, narrow)
            groups = [
                (kind, columns)
                for kind, flags in enumerate(active)
                for columns in _groups(kind)
                if kind not in fixed and flags[:, columns].any()
            ]
            if not groups:
                return active, narrow
            best = [float(np.max(worth[kind][:, columns][active[kind][:, columns]])) for kind, columns in groups]
            poorest = int(np.argmin(best))
            changed = tuple(flags.copy() for flags in active)
            thin = tuple(flags.copy() for flags in narrow)
            if best[poorest] <= 0.0:
                kind, columns = groups[poorest]
                changed[kind][:, columns] = False
            else:
                for kind in range(len(active)):
                    if kind in fixed:
                        continue
                    if kind in _OF_MANY:
                        pays = self._together(kind, worth[kind] > 0.0)
                        widened = active[kind] & narrow[kind] & ~settled[kind] & pays
                        thin[kind][active[kind] & ~pays] = True
                        thin[kind][widened], settled[kind][widened] = False, True
                    else:
                        changed[kind][worth[kind] <= 0.0] = False
                if _is_same((*changed, *thin), (*active, *narrow)):
                    return active, narrow
            active, narrow = changed, thin

    def _together(self, kind: int, pays: Bools) -> Bools:
        """Return which parameters pay, or one of those that they are linked with."""
        if kind != OFFSET:
            return pays
        together = np.zeros_like(pays)
        np.logical_or.at(together, self.linked, pays)
        return together[self.linked]

    def _worth(self, fit: FittedConstants, active: tuple[Bools, ...], narrow: tuple[Bools, ...]) -> list[Floats]:
        """Return for each parameter by how much its evidence exceeds its price; below 0 where it is too small."""
        price = math.log(max(len(self.seen), 2))
        smallest = self.smallest()
        agreed = self._agreed_shift(fit.constants[OFFSET], active[OFFSET], narrow[OFFSET])
        worth = []
        for kind, index in enumerate(fit.column_of):
            value = np.full(index.shape, -np.inf)
            constants = fit.constants[kind]
            if kind == OFFSET:
                constants = np.where(active[kind].any(axis=0), constants - agreed, constants)
            for columns in _groups(kind):
                free = active[kind][:, columns].all(axis=1)
                is_narrow = narrow[kind][:, columns].any(axis=1)
                value[np.flatnonzero(free)[:, None], columns] = -1.0
                rows = np.flatnonzero(free & ~is_narrow)
                thin = np.flatnonzero(free & is_narrow)
                if len(thin) and kind in _OF_MANY:
                    theta, square = self._if_wide(fit, kind, index[thin][:, columns], thin, columns)
                    evidence = square - len(columns) * price - 2.0 * math.log(max(len(rows), 1))
                    is_fault = np.linalg.norm(theta, axis=1) > BEYOND_DRIFT * smallest[kind]
                    value[thin[:, None], columns] = np.where(is_fault, evidence, -1.0)[:, None]
                if not len(rows):
                    continue
                at = index[rows][:, columns]
                theta = constants[rows][:, columns]
                blocks = fit.covariance[at[:, :, None], at[:, None, :]]
                shared = {MOUNT: CAMERA_MOUNT, DELAY: CAMERA_DELAY}.get(kind)
                is_shared = kind == OFFSET or (shared is not None and active[shared][:, columns].any())
                if is_shared and len(rows) > 1:
                    sigma = np.broadcast_to(self.scales.constant[kind], index.shape)[rows, columns[0]]
                    mean, blocks = _against_the_mean(theta, fit.covariance, at, sigma)
                    # Offsets are against what most drives agree on, where there are any that do not move.
                    theta = theta if kind == OFFSET and narrow[kind].any() else mean
                square = np.einsum("ni,ni->n", theta, np.linalg.solve(blocks, theta[:, :, None])[:, :, 0])
                evidence = square - len(columns) * price - 2.0 * math.log(len(rows))
                size = np.linalg.norm(theta, axis=1)
                is_fault = size > BEYOND_DRIFT * smallest[kind]
                if (kind, columns) != (OFFSET, [2]):  # Heights may be above something else.
                    is_fault &= size < _PLAUSIBLE * np.maximum(WIDE.constant[kind], np.max(self.scales.constant[kind]))
                if kind == FOCAL:
                    is_fault &= blocks[:, 0, 0] < _SIGMA_FOCAL**2 / 2.0
                value[rows[:, None], columns] = np.where(is_fault, evidence, -1.0)[:, None]
            worth.append(value)
        return worth

    def _if_wide(
        self, fit: FittedConstants, kind: int, at: Ints, rows: Ints, columns: list[int]
    ) -> tuple[Floats, Floats]:
        """Return what parameters (N, width) that are narrow would be if they were not, and their squared sigmas (N).

        Their prior is taken out of the posterior, all others stay as they are. `at` are their places in the covariance.
        """
        wide = np.broadcast_to(np.asarray(self.scales.constant[kind]), fit.constants[kind].shape)[rows][:, columns]
        pull = np.maximum(self.smallest()[kind] ** -2.0 - wide**-2.0, 0.0)
        information = np.linalg.inv(fit.covariance[at[:, :, None], at[:, None, :]])
        right = np.einsum("nij,nj->ni", information, fit.constants[kind][rows][:, columns])
        freed = information - pull[:, :, None] * np.eye(len(columns))
        theta = np.linalg.solve(freed, right[:, :, None])[:, :, 0]
        return theta, np.einsum("ni,ni->n", theta, right)

    def _agreed_shift(self, offset: Floats, active: Bools, narrow: Bools) -> Floats:
        """Return the place (3) on which most drives agree, of the offsets that are free: 0 where some became narrow.

        These are where they should be, however many others are off by the same.
        """
        weight = np.bincount(self.seen.segment, minlength=len(active))
        agreed = agreed_shift(offset, active & ~narrow, weight)
        return np.where(np.any(active & narrow & ~self.bound[OFFSET], axis=0), 0.0, agreed)

    def _regauged(self, state: State, active: Bools, narrow: Bools) -> State:
        """Return the state with everything moved so that the place on which most drives agree stays."""
        shift = self._agreed_shift(state.constants[OFFSET], active, narrow)
        offset = np.where(np.any(active & ~narrow, axis=0), state.constants[OFFSET] - shift, state.constants[OFFSET])
        points = state.point_in_world_m - shift
        return replace(state.with_offset(offset), point_in_world_m=points)


@dataclass(frozen=True, eq=False)
class FittedConstants:
    """Constants by kind, and the covariance of those that are free; `column_of` (by kind) is where they are in it."""

    constants: tuple[Floats, ...]
    covariance: Floats
    column_of: tuple[Ints, ...]


@dataclass(frozen=True, eq=False)
class EquationsOfConstants:
    """The normal equations of constants with all else eliminated and without priors, where they are linearised.

    `column_of` (by kind) says which of the columns of `information` (C, C) and of the right side (C) each has.
    """

    column_of: tuple[Ints, ...]
    information: Floats
    right: Floats

    @staticmethod
    def at(problem: Adjustment, state: State) -> EquationsOfConstants:
        """Return those of a problem, at its solution."""
        assert state.covariance is not None
        first = 3 * problem.things
        index = tuple(np.where(columns >= 0, columns - first, -1) for columns in problem.column_of)
        information = np.asarray(np.linalg.inv(state.covariance))
        prior, values = _prior(problem.scales, problem.active), _values(state, problem.active)
        return EquationsOfConstants(index, information - np.diag(prior), information @ values)

    def solved(self, active: tuple[Bools, ...], scales: Scales) -> FittedConstants:
        """Return what some of the constants are, the others zero, with priors."""
        used = np.concatenate([columns[flags] for columns, flags in zip(self.column_of, active, strict=True)])
        covariance = np.linalg.inv(self.information[np.ix_(used, used)] + np.diag(_prior(scales, active)))
        solution = covariance @ self.right[used]
        constants, column_of, done = [], [], 0
        for flags in active:
            count = int(flags.sum())
            values, at = np.zeros(flags.shape), np.full(flags.shape, -1)
            values[flags], at[flags] = solution[done : done + count], np.arange(done, done + count)
            done += count
            constants.append(values)
            column_of.append(at)
        return FittedConstants(tuple(constants), covariance, tuple(column_of))


def _is_same(some: tuple[Bools, ...], others: tuple[Bools, ...]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(some, others, strict=True))


def _groups(kind: int) -> list[list[int]]:
    """Return the columns of a kind that stand or fall together."""
    if kind == OFFSET:
        return [[0, 1], [2]]
    return [[0], [1], [2]] if kind in (MOUNT, CAMERA_MOUNT) else [[0]]


def _against_the_mean(theta: Floats, covariance: Floats, at: Ints, sigma: Floats) -> tuple[Floats, Floats]:
    """Return values (N, width) and covariances against their weighted mean, which nothing but the priors tells.

    `at` (N, width) are their places in the covariance, `sigma` (N) the deviations of their priors.
    """
    share = sigma**-2.0 / np.sum(sigma**-2.0)
    theta = theta - share @ theta
    width = at.shape[1]
    out = np.empty((len(at), width, width))
    for i in range(width):
        for j in range(width):
            part = covariance[np.ix_(at[:, i], at[:, j])]
            out[:, i, j] = np.diag(part) - part @ share - share @ part + share @ part @ share
    return theta, out + 1e-12 * np.eye(width)


def _gain_of_held_out(problem: Adjustment, state: State) -> Floats:
    """Return by how much the rays of each object meet better with constants that the other half of the objects tells.

    Drift is one of all that is seen from a place: what the other half tells of it is known with constants and without.
    """
    half = halves(state.point_in_world_m)
    begun = replace(state, drift=np.zeros_like(state.drift))
    given = replace(begun, constants=tuple(np.zeros_like(values) for values in begun.constants))
    nothing = tuple(np.zeros_like(flags) for flags in problem.active)
    ways = ((given, nothing, Links.none()), (begun, problem.active, problem.links))
    gains = []
    for side in (0, 1):
        fitted, judged = (
            problem.seen.take((half[problem.seen.thing] == side) == is_fitted) for is_fitted in (True, False)
        )
        costs = []
        for start, active, links in ways:
            part = Adjustment(fitted, problem.chain, problem.scales, active, problem.things, links)
            fit = replace(adjust(part, start, tolerances=_REFIT), own=np.zeros_like(state.own))
            placed = triangulate(judged, replace(fit, point_in_world_m=state.point_in_world_m), tolerance=3.0)
            placed = triangulate(judged, placed, rounds=4)
            costs.append(np.bincount(judged.thing, weights=cost(judged, placed), minlength=problem.things))
        gains.append((costs[0] - costs[1])[np.unique(judged.thing)])
    return np.concatenate(gains)


def chance_of_gain(gain: Floats) -> float:
    """Return the probability that what objects (N) gain is luck, by their mean and by their ranks."""
    from scipy import stats  # Slow to import, and only this test needs it.

    if not gain.any():
        return 1.0
    by_rank = float(stats.wilcoxon(gain, alternative="greater").pvalue)
    if len(gain) < _FEW_GAINS:
        return by_rank
    mean, scatter = float(gain.mean()), float(gain.std(ddof=1)) / math.sqrt(len(gain))
    chance = float(stats.t.sf(mean / scatter, len(gain) - 1)) if scatter > 0.0 else float(mean <= 0.0)
    return min(1.0, 2.0 * min(chance, by_rank))


def halves(point: Floats) -> Ints:
    """Deal objects into two halves by turns along their places, so that drives see some of both everywhere."""
    order = np.lexsort((point[:, 2], point[:, 1], np.round(point[:, 0] / 10.0)))
    half = np.empty(len(point), np.int64)
    half[order] = np.arange(len(point)) % 2
    return half
