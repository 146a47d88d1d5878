"""What the pictures show besides lights and traffic: all that stands still."""

from __future__ import annotations

from dataclasses import dataclass

from valuemap.simulate.city import City
from valuemap.simulate.furniture import Bars, Signs, Trees, carry_lights, furnish
from valuemap.simulate.houses import Fronts, build_fronts
from valuemap.simulate.pavement import GroundQuads, pave
from valuemap.simulate.rows import join_rows


@dataclass(frozen=True, eq=False)
class Scenery:
    """All that stands still and is no light."""

    ground: GroundQuads
    fronts: Fronts
    bars: Bars
    signs: Signs
    trees: Trees


def build_scenery(city: City, *, seed: int) -> Scenery:
    """Furnish a city."""
    street_bars, signs, trees = furnish(city.streets, seed)
    return Scenery(
        ground=pave(city.streets, seed),
        fronts=build_fronts(city.streets, seed),
        bars=join_rows(
            [
                carry_lights(city.lights, city.streets, share_poles=True),
                carry_lights(city.lookalikes, city.streets, share_poles=False),
                street_bars,
            ]
        ),
        signs=signs,
        trees=trees,
    )
