"""What is wrong with a dataset: mistakes in poses, frames, cameras, boxes, passes, time and rows, and how to undo them.

`agreement.py` is the measure that the rest stands on, `registry.py` lists all faults, `examine.py` looks for them.
"""

from __future__ import annotations

from valuemap.check.examine import Examination, examine
from valuemap.check.fault import Finding
from valuemap.check.quality import far_images

__all__ = ["Examination", "Finding", "examine", "far_images"]
