"""Which of two sets of poses explains the same detections better: by the score that maps are made with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from valuemap.config import MapConfig
from valuemap.dataset import Dataset
from valuemap.drives import InOrder, in_driving_order
from valuemap.progress import Progress, counted
from valuemap.robust import MISFIT_STEPS, Noise, Scene, misfits
from valuemap.sightings import cast_sightings
from valuemap.tiles.piece import piece_of_rows
from valuemap.tiles.source import VIEWPOINT_SHARE, InMemory


@dataclass(frozen=True)
class Comparison:
    """Minus twice the log likelihood of the same detections with poses before and after, up to one constant.

    Each has the noise that is likeliest for it. `price` is that of the parameters by which poses differ, as far as this
    sample pays it: they were estimated from all detections, and explain all of them. `sought` is the noise of the poses
    before, which a map of these need not seek again.
    """

    before: float
    after: float
    price: float
    detections: int
    sought: Noise | None = None

    @property
    def is_better(self) -> bool:
        """Whether the poses after explain more than they cost."""
        return self.after + self.price < self.before

    def figures(self) -> dict[str, float]:
        """Return what `run.json` says of it."""
        figures = {"misfit_before": self.before, "misfit_after": self.after, "price": self.price}
        return {name: round(figure, 1) for name, figure in figures.items()}


def compare_poses(
    before: Dataset, after: Dataset, price: float, config: MapConfig, *, threads: int, progress: Progress
) -> Comparison:
    """Return how badly the detections of a sample fit the poses of two datasets, whose difference has a `price`.

    Both datasets have the same images and detections.
    """
    old = InMemory(before, config).sample()
    new = _same_images(after, old, config)
    first, second = (
        Scene(one.dataset, one.drives, cast_sightings(one.dataset)[0], config.vote.unit_m) for one in (old, new)
    )
    # They are in another order where poses tell the order.
    order = np.argsort(new.detection_id)
    second_of_first = order[np.searchsorted(new.detection_id, old.detection_id, sorter=order)]
    with counted(progress, "comparing poses", MISFIT_STEPS) as tell:
        (of_old, of_new), rays, sought = misfits((first, second), second_of_first, config, threads=threads, tell=tell)
    return Comparison(of_old, of_new, price * rays / len(before.detections), rays, sought)


def _same_images(dataset: Dataset, like: InOrder, config: MapConfig) -> InOrder:
    """Return the images that something holds, in driving order, from another dataset of the same images."""
    ordered = in_driving_order(dataset, viewpoint_step_m=config.vote.farthest_m * VIEWPOINT_SHARE)
    return piece_of_rows(ordered, np.flatnonzero(np.isin(ordered.image_id, like.image_id)))
