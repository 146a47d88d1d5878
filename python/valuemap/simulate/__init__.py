"""A simulated city with known truth: what a fleet with a noisy detector and noisy poses would record."""

from valuemap.simulate.city import build_city
from valuemap.simulate.presets import PRESETS
from valuemap.simulate.simulation import simulate

__all__ = ["PRESETS", "build_city", "simulate"]
