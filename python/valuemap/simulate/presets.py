"""Ready-made cities: a small one to try things, two of the size and kind of the paper's data, and one beyond them."""

from __future__ import annotations

from dataclasses import replace

from valuemap.config import SimulationConfig

PRESETS: dict[str, SimulationConfig] = {
    "small": SimulationConfig(
        streets_north_south=4,
        streets_east_west=3,
        signalised_share=0.5,
        lights=30,
        passes_per_street=4,
        frame_spacing_m=2.5,
        standing_interval_s=0.7,
        keep_before_signal_m=90.0,
    ),
    "sf": SimulationConfig(
        streets_north_south=18,
        streets_east_west=16,
        signalised_share=0.16,
        lights=183,
        lights_per_approach=1.7,
        main_street_pull=0.7,
        passes_per_street=1,
        images=12_048,
        standing_interval_s=0.33,
        keep_before_signal_m=85.0,
        detections=17_198,
        min_box_height_px=6.0,
    ),
    # So many clusters for so few lights mean that the lights were seen from far down long streets.
    "nyc": SimulationConfig(
        streets_north_south=60,
        streets_east_west=54,
        block_east_m=220.0,
        block_north_m=200.0,
        signalised_share=0.1,
        lights=1_906,
        lights_per_approach=1.4,
        main_street_pull=1.5,
        passes_per_street=1,
        images=360_207,
        frame_spacing_m=1.0,
        standing_interval_s=0.25,
        keep_before_signal_m=150.0,
        detections=547_689,
        focal_px=550.0,
        max_sight_m=160.0,
        min_box_height_px=3.5,
        half_recall_height_px=2.5,
    ),
}
"""Settings by the name that `valuemap simulate --preset` takes."""
PRESETS["10x-nyc"] = replace(PRESETS["nyc"], districts=10)
