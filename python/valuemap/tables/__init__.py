"""The typed tables that all stages share, and the one way to read, check and write them.

Each table is a frozen dataclass of arrays of one length. Each field says which columns of the file on disk it stands
for, so that reading, checking and writing are one mechanism for all tables. Tables are held in ascending order of their
key, so that nothing depends on the order of rows in a file.

`dataset.py`, `truth.py` and `map.py` say which tables there are. `column.py`, `categories.py` and `table.py` are what
these are made of; `read.py`, `check.py` and `write.py` are the ways in and out. `candidates.py` is what becomes labels,
and `covariance.py` turns covariances into columns and back.
"""

from valuemap.tables.categories import Categories
from valuemap.tables.dataset import Cameras, Detections, Images, RejectedRows
from valuemap.tables.map import Changes, IdBridge, Labels, Rejected, Votes
from valuemap.tables.table import Table
from valuemap.tables.truth import GeographicTruth, Truth, TruthDetections, TruthPoints

__all__ = [
    "Cameras",
    "Categories",
    "Changes",
    "Detections",
    "GeographicTruth",
    "IdBridge",
    "Images",
    "Labels",
    "Rejected",
    "RejectedRows",
    "Table",
    "Truth",
    "TruthDetections",
    "TruthPoints",
    "Votes",
]
