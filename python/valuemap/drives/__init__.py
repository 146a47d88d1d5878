"""Driving order, told once: which images are one drive, in which order, and from which places they were taken.

All that follows looks only at times, numbers in names, poses and which images share a pass and a camera; never at
the values of ids, the order of rows or what passes are called. Images are put into an order of their own first (by
time, then place: `shots.py`), and all ties are broken by it.

1. *Streams*: the images of one camera in one pass.
2. *Rigs* (`rigs.py`): streams that expose together, each always in the same place seen from the other, are cameras of
   one vehicle. Their images share exposures.
3. *Order* (`order.py`): the exposures of a vehicle by time, else by the numbers in their names (`names.py`), else along
   the chain of nearest poses (`chain.py`). An order that makes the way (`way.py`) clearly longer than the chain is not
   believed. Names of a rig's images name its cameras as well: what does so tells no order (`name_exposures.py`).
   Names also order what one camera took within one second of a clock of whole seconds.
4. *Drives* (`cuts.py`): the order is cut where time or place jumps, and where the vehicle comes back to where it was.
5. *Viewpoints*: a new one begins where the camera has moved more than a step since the last one began.

`find.py` puts the steps together; `in_order.py` makes a dataset whose rows follow the drives.
"""

from valuemap.drives.cuts import Usual
from valuemap.drives.find import Drives, Ways, find_drives
from valuemap.drives.in_order import InOrder, driving_order, from_left_to_right, in_driving_order
from valuemap.drives.shots import are_dates

__all__ = [
    "Drives",
    "InOrder",
    "Usual",
    "Ways",
    "are_dates",
    "driving_order",
    "find_drives",
    "from_left_to_right",
    "in_driving_order",
]
