"""A map of any size: cells of a fixed grid, each solved on its own, and one rule for what lies across their borders.

1. `grid`: the cells of a dataset.
2. `piece`: what a cell is solved with: its images and those around it.
3. `sample`: the part of a dataset that is calibrated on.
4. `fingerprint`: what tells pieces apart.
5. `solve`: the labels of one cell.
6. `seams`: the labels of all cells as one map.
"""
