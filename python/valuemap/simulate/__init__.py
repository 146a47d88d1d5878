"""A simulated city with known truth: what a fleet with a noisy detector and noisy poses would record."""

from valuemap.simulate.city import build_city
from valuemap.simulate.districts import simulate_districts
from valuemap.simulate.presets import PRESETS
from valuemap.simulate.simulation import Recording, record_city, record_drives, simulate

__all__ = ["PRESETS", "Recording", "build_city", "record_city", "record_drives", "simulate", "simulate_districts"]
