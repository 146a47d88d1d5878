"""How good a map is: labels matched one to one with known objects, then counted and measured.

A label and an object of one class may be matched within a radius. Of all one-to-one matchings the one with
the most matches counts, and of those the one with the smallest sum of distances. Then every label is

    true       matched with an object,
    duplicate  not matched, but within the radius of an object that another label took,
    false      neither,

and every object is found, missed, or not recoverable: nobody can place an object that was not detected from
two sufficiently different directions, so such objects do not count in the recall.

`objects_file.py` reads files of objects, `truth.py` brings the truth to the frame of the map, `recoverable.py` says
which objects could be found, `matching.py` matches, and `accuracy.py`, `completeness.py`, `chance.py` and
`reliability.py` each say one thing about the matches; `evaluation.py` puts them together.
"""

from valuemap.evaluate.accuracy import PositionalAccuracy, measure_accuracy
from valuemap.evaluate.chance import ChanceFloor, measure_chance
from valuemap.evaluate.completeness import Completeness, measure_completeness
from valuemap.evaluate.evaluation import Evaluation, evaluate_map
from valuemap.evaluate.matching import LABEL_OUTCOMES, OBJECT_OUTCOMES, Matches, match_labels
from valuemap.evaluate.recoverable import recoverable_objects
from valuemap.evaluate.reliability import ExistenceRange, measure_reliability
from valuemap.evaluate.truth import TrueObjects, read_truth

__all__ = [
    "LABEL_OUTCOMES",
    "OBJECT_OUTCOMES",
    "ChanceFloor",
    "Completeness",
    "Evaluation",
    "ExistenceRange",
    "Matches",
    "PositionalAccuracy",
    "TrueObjects",
    "evaluate_map",
    "match_labels",
    "measure_accuracy",
    "measure_chance",
    "measure_completeness",
    "measure_reliability",
    "read_truth",
    "recoverable_objects",
]
