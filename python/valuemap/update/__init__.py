"""A map brought up to date: new passes added to a map that is there, and what changed since.

1. `join`: the dataset of the map and the new one as one.
2. `looks`: the opportunities that each epoch had to see an object.
3. `changes`: what became of each label.
4. `moved`: passes that are added to a map that control points moved with its dataset.
5. `update`: all of it.
"""

from valuemap.update.update import compare, update_map

__all__ = ["compare", "update_map"]
