"""The tables of a map: its labels and their votes, what became of them in an update, and what became no label."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from valuemap.arrays import Floats, Ints
from valuemap.tables.categories import Categories
from valuemap.tables.column import column
from valuemap.tables.table import Table

LABEL_STATES = ("confirmed", "gone", "moved", "new", "uncertain")
"""What `valuemap update` says about a label."""


@dataclass(frozen=True, eq=False, repr=False)
class Labels(Table):
    """Accepted objects.

    Positions (N, 3) in metres in the frame of the dataset; covariance (N, 6) in m² as xx, xy, xz, yy, yz, zz;
    `votes` counts images, `passes` the passes they come from; `reprojection_rms_px` over the voters;
    `max_parallax_rad` the largest angle between two voters' directions to the object; `first_seen_s` and
    `last_seen_s` the voters' first and last timestamps (NaN where there are none); width and height from the
    voters' boxes at their depths; `facing_azimuth_rad` (0 to 2 pi, clockwise from north seen from above) where the
    voters' cameras are from it, and `facing_concentration` (0 to 1) how much they are on one side of it;
    `expected` counts the images that should have seen it and `existence` is the
    probability that it exists (robust method); `absolute_covariance_m2` (N, 6) is there where it is known how well the
    whole map is placed, from control points or from how far drives were moved to each other, `covariance_m2` is against
    the labels around; lon, lat in degrees and height in metres
    on WGS84 where geo-referenced; `state` is what `valuemap update` says about it.
    """

    KEY: ClassVar[str | None] = "label_id"
    MAY_BE_EMPTY: ClassVar[bool] = True

    label_id: Ints = column("int", ("label_id",))
    class_name: Categories = column("category", ("class",))
    position_in_world_m: Floats = column("float", ("x", "y", "z"))
    covariance_m2: Floats = column(
        "float",
        (
            "covariance_xx",
            "covariance_xy",
            "covariance_xz",
            "covariance_yy",
            "covariance_yz",
            "covariance_zz",
        ),
    )
    votes: Ints = column("int", ("votes",))
    passes: Ints = column("int", ("passes",))
    object_width_m: Floats = column("float", ("object_width_m",))
    object_height_m: Floats = column("float", ("object_height_m",))
    reprojection_rms_px: Floats = column("float", ("reprojection_rms_px",))
    max_parallax_rad: Floats = column("float", ("max_parallax_rad",))
    first_seen_s: Floats = column("float", ("first_seen",), nullable=True)
    last_seen_s: Floats = column("float", ("last_seen",), nullable=True)
    facing_azimuth_rad: Floats = column("float", ("facing_azimuth_rad",))
    facing_concentration: Floats = column("float", ("facing_concentration",))
    absolute_covariance_m2: Floats | None = column(
        "float",
        (
            "absolute_covariance_xx",
            "absolute_covariance_xy",
            "absolute_covariance_xz",
            "absolute_covariance_yy",
            "absolute_covariance_yz",
            "absolute_covariance_zz",
        ),
        optional=True,
    )
    lon_lat_height: Floats | None = column("float", ("lon", "lat", "height"), optional=True)
    expected: Ints | None = column("int", ("expected",), optional=True)
    existence: Floats | None = column("float", ("existence",), optional=True)
    state: Categories | None = column("category", ("state",), optional=True)

    @property
    def stated_covariance_m2(self) -> Floats:
        """The covariance (N, 6) of positions in the world, m²: the absolute one where it is known."""
        return self.covariance_m2 if self.absolute_covariance_m2 is None else self.absolute_covariance_m2


@dataclass(frozen=True, eq=False, repr=False)
class Votes(Table):
    """Which detection supports which label, and how closely: sorted by label, then image."""

    MAY_BE_EMPTY: ClassVar[bool] = True

    label_id: Ints = column("int", ("label_id",))
    detection_id: Ints = column("int", ("detection_id",))
    image_id: Ints = column("int", ("image_id",))
    residual_px: Floats = column("float", ("residual_px",))
    residual_sigmas: Floats = column("float", ("residual_sigmas",))


@dataclass(frozen=True, eq=False, repr=False)
class Changes(Table):
    """What became of each label when passes were added to a map, by label id.

    `change` is added, changed, moved, removed or unchanged, `state` that of the label. Positions (N, 3) in metres in
    the frame of the dataset: now, and before (NaN where there was none). The rest is the evidence: in how many `looks`
    the added passes should have seen it, in how many of these they did (`hits`) and did not (`misses`), by how much
    they speak for it (`log_odds`, natural logarithm of the likelihood ratio), and the times of the first and last look.
    """

    MAY_BE_EMPTY: ClassVar[bool] = True

    label_id: Ints = column("int", ("label_id",))
    change: Categories = column("category", ("change",))
    state: Categories = column("category", ("state",))
    class_name: Categories = column("category", ("class",))
    position_in_world_m: Floats = column("float", ("x", "y", "z"))
    from_m: Floats = column("float", ("from_x", "from_y", "from_z"), nullable=True)
    looks: Ints = column("int", ("looks",))
    hits: Ints = column("int", ("hits",))
    misses: Ints = column("int", ("misses",))
    log_odds: Floats = column("float", ("log_odds",))
    first_look_s: Floats = column("float", ("first_look",), nullable=True)
    last_look_s: Floats = column("float", ("last_look",), nullable=True)


@dataclass(frozen=True, eq=False, repr=False)
class IdBridge(Table):
    """Which label of an older map is which of a newer one, and how many votes they have in common."""

    MAY_BE_EMPTY: ClassVar[bool] = True

    old_label_id: Ints = column("int", ("old_label_id",))
    label_id: Ints = column("int", ("label_id",))
    common_votes: Ints = column("int", ("common_votes",))


REJECTION_REASONS: Mapping[str, str] = {
    "votes": "too few images vote for it (min_votes), and what is known of its class does not make up for that",
    "ratio": "it has too few votes for what is usual here (min_vote_ratio)",
    "existence": "it probably does not exist: what votes for it may meet by chance, and too few of the images that "
    "should have seen it did (min_existence)",
    "merged": "it is one object with another label",
    "class": "a label of another class has the place",
    "parallax": "its rays are too parallel to say how far away it is (min_parallax_deg)",
    "range": "it is too near to its cameras or too far from them (min_range_m, max_range_m)",
}
"""Why a hypothesis became no label: the test that it failed, in words."""


@dataclass(frozen=True, eq=False, repr=False)
class Rejected(Table):
    """The best hypotheses that became no labels.

    Positions (N, 3) in metres in the frame of the dataset; `votes` counts images, `passes` the passes they come from,
    `expected` the images that should have seen it; `existence` is NaN where it never came to that test; `reason` is one
    of `REJECTION_REASONS`; `rival` is the label that has its detections or its place, -1 where there is none.
    `value` is what that test looked at and `threshold` what it asks for: votes, degrees, metres, sigmas or a share,
    by the reason; NaN where there is no such number.
    """

    KEY: ClassVar[str | None] = "hypothesis_id"
    MAY_BE_EMPTY: ClassVar[bool] = True

    hypothesis_id: Ints = column("int", ("hypothesis_id",))
    class_name: Categories = column("category", ("class",))
    position_in_world_m: Floats = column("float", ("x", "y", "z"))
    votes: Ints = column("int", ("votes",))
    passes: Ints = column("int", ("passes",))
    expected: Ints = column("int", ("expected",))
    existence: Floats = column("float", ("existence",), nullable=True)
    reason: Categories = column("category", ("reason",))
    rival: Ints | None = column("int", ("rival",), optional=True)
    value: Floats | None = column("float", ("value",), nullable=True, optional=True)
    threshold: Floats | None = column("float", ("threshold",), nullable=True, optional=True)
