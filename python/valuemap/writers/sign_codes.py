"""One table of what traffic signs and street furniture are called: Mapillary, OpenStreetMap, Vienna Convention, MUTCD.

Classes of detectors are matched by their words, whatever joins them: `regulatory--stop--g1`, `stop_sign` and `Stop` are
one. Where a sign carries a number (a speed, a height), it is taken from the name of the class.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Sign:
    """What one kind of object is called; `{}` stands for its number.

    `mapillary` is the name without group (`--g1`), `osm` are tags of a node, `vienna` is the number of the Vienna
    Convention of 1968 and `mutcd` that of the Manual on Uniform Traffic Control Devices; None where there is none.
    `names` are what else it is called.
    """

    mapillary: str
    osm: dict[str, str]
    vienna: str | None = None
    mutcd: str | None = None
    names: tuple[str, ...] = field(default=())


def _sign(value: str) -> dict[str, str]:
    return {"traffic_sign": value}


def _hazard(value: str) -> dict[str, str]:
    return {"traffic_sign": "hazard", "hazard": value}


SIGNS = (
    Sign("object--traffic-light", {"highway": "traffic_signals"}, names=("traffic light", "traffic lights", "light")),
    Sign("object--street-light", {"highway": "street_lamp"}, names=("street light", "street lamp", "lamp")),
    Sign("object--fire-hydrant", {"emergency": "fire_hydrant"}, names=("fire hydrant", "hydrant")),
    Sign("object--bench", {"amenity": "bench"}, names=("bench",)),
    Sign("object--trash-can", {"amenity": "waste_basket"}, names=("trash can", "waste basket", "bin")),
    Sign("object--mailbox", {"amenity": "post_box"}, names=("mailbox", "post box")),
    Sign(
        "object--parking-meter", {"amenity": "vending_machine", "vending": "parking_tickets"}, names=("parking meter",)
    ),
    Sign("object--bike-rack", {"amenity": "bicycle_parking"}, names=("bike rack",)),
    Sign("object--manhole", {"man_made": "manhole"}, names=("manhole",)),
    Sign("object--support--utility-pole", {"power": "pole"}, names=("utility pole",)),
    Sign("object--vegetation--tree", {"natural": "tree"}, names=("tree",)),
    Sign("object--bollard", {"barrier": "bollard"}, names=("bollard",)),
    Sign("construction--flat--curb-ramp", {"barrier": "kerb", "kerb": "lowered"}, names=("curb ramp", "kerb ramp")),
    Sign("regulatory--stop", _sign("stop"), "B,2a", "R1-1", ("stop", "stop sign")),
    Sign("regulatory--yield", _sign("give_way"), "B,1", "R1-2", ("yield", "give way")),
    Sign("regulatory--priority-road", _sign("priority_road"), "B,3", None, ("priority road",)),
    Sign("regulatory--priority-over-oncoming-vehicles", _sign("priority_over_oncoming"), "B,6"),
    Sign("regulatory--give-way-to-oncoming-traffic", _sign("give_way_to_oncoming"), "B,5"),
    Sign("regulatory--no-entry", _sign("no_entry"), "C,1a", "R5-1", ("no entry", "do not enter")),
    Sign("regulatory--road-closed-to-vehicles", _sign("no_vehicles"), "C,2", None, ("road closed to vehicles",)),
    Sign("regulatory--no-bicycles", _sign("no_bicycles"), "C,3c", "R5-6", ("no bicycles",)),
    Sign("regulatory--no-heavy-goods-vehicles", _sign("hgv"), "C,3e", "R5-2", ("no trucks", "no heavy goods vehicles")),
    Sign("regulatory--no-pedestrians", _sign("no_pedestrians"), "C,3i", "R9-3", ("no pedestrians",)),
    Sign("regulatory--width-limit", _sign("maxwidth"), "C,5", None, ("width limit",)),
    Sign("regulatory--height-limit", _sign("maxheight"), "C,6", "R12-2a", ("height limit",)),
    Sign("regulatory--weight-limit", _sign("maxweight"), "C,7", "R12-1", ("weight limit",)),
    Sign("regulatory--no-left-turn", _sign("no_left_turn"), "C,11a", "R3-2", ("no left turn",)),
    Sign("regulatory--no-right-turn", _sign("no_right_turn"), "C,11b", "R3-1", ("no right turn",)),
    Sign("regulatory--no-u-turn", _sign("no_u_turn"), "C,12", "R3-4", ("no u turn",)),
    Sign("regulatory--no-overtaking", _sign("overtaking"), "C,13a", "R4-1", ("no overtaking", "do not pass")),
    Sign(
        "regulatory--maximum-speed-limit-{}",
        {**_sign("maxspeed"), "valuemap:number": "{}"},  # `maxspeed` is in km/h, and a class does not say its unit.
        "C,14",
        "R2-1",
        ("speed limit {}", "maximum speed limit {}", "maxspeed {}"),
    ),
    Sign("regulatory--no-parking", _sign("no_parking"), "C,18", "R8-3", ("no parking",)),
    Sign("regulatory--no-stopping", _sign("no_stopping"), "C,19", "R7-4", ("no stopping",)),
    Sign("regulatory--turn-left", _sign("turn_left"), "D,1a", "R3-5L", ("turn left",)),
    Sign("regulatory--turn-right", _sign("turn_right"), "D,1a", "R3-5R", ("turn right",)),
    Sign("regulatory--go-straight", _sign("go_straight"), "D,1a", "R3-5A", ("go straight",)),
    Sign("regulatory--keep-left", _sign("keep_left"), "D,2", "R4-8", ("keep left",)),
    Sign("regulatory--keep-right", _sign("keep_right"), "D,2", "R4-7", ("keep right",)),
    Sign("regulatory--roundabout", _sign("roundabout"), "D,3", "R6-5P", ("roundabout",)),
    Sign("regulatory--bicycles-only", _sign("bicycle"), "D,4", None, ("bicycles only", "cycle path")),
    Sign("regulatory--pedestrians-only", _sign("pedestrian"), "D,5", None, ("pedestrians only", "foot path")),
    Sign("regulatory--one-way-straight", _sign("oneway"), "E,3b", "R6-1", ("one way",)),
    Sign("regulatory--one-way-left", _sign("oneway"), "E,3a", "R6-1L", ("one way left",)),
    Sign("regulatory--one-way-right", _sign("oneway"), "E,3a", "R6-1R", ("one way right",)),
    Sign(
        "information--pedestrians-crossing", _sign("crossing"), "E,12a", None, ("pedestrian crossing", "crosswalk sign")
    ),
    Sign("information--parking", _sign("parking"), "E,14a", "D4-1", ("parking",)),
    Sign("information--bus-stop", {"highway": "bus_stop"}, "E,15", "R7-107", ("bus stop",)),
    Sign("information--dead-end", _sign("dead_end"), "G,13", "W14-1", ("dead end", "no through road")),
    Sign("information--hospital", _sign("hospital"), "F,1a", "D9-2", ("hospital",)),
    Sign("warning--curve-left", _hazard("curve"), "A,1a", "W1-2L", ("curve left",)),
    Sign("warning--curve-right", _hazard("curve"), "A,1b", "W1-2R", ("curve right",)),
    Sign("warning--road-narrows", _hazard("road_narrows"), "A,4a", "W5-1", ("road narrows",)),
    Sign("warning--uneven-road", _hazard("bump"), "A,7a", "W8-8", ("uneven road",)),
    Sign(
        "warning--slippery-road-surface",
        _hazard("slippery_road"),
        "A,9",
        "W8-5",
        ("slippery road", "slippery road surface"),
    ),
    Sign("warning--falling-rocks-or-debris-right", _hazard("falling_rocks"), "A,11a", "W8-14", ("falling rocks",)),
    Sign("warning--pedestrians-crossing", _hazard("pedestrians"), "A,12", "W11-2", ("pedestrians crossing ahead",)),
    Sign("warning--children", _hazard("children"), "A,13", "S1-1", ("children", "school zone")),
    Sign("warning--bicycles-crossing", _hazard("cyclists"), "A,14", "W11-1", ("bicycles crossing",)),
    Sign("warning--wild-animals", _hazard("animal_crossing"), "A,15b", "W11-3", ("wild animals", "animal crossing")),
    Sign("warning--roadworks", _hazard("roadworks"), "A,16", "W21-1", ("roadworks", "road works", "construction")),
    Sign("warning--traffic-signals", _hazard("traffic_signals"), "A,17", "W3-3", ("traffic signals ahead",)),
    Sign("warning--roundabout", _hazard("roundabout"), "A,22", "W2-6", ("roundabout ahead",)),
    Sign("warning--two-way-traffic", _hazard("two_way_traffic"), "A,23", "W6-3", ("two way traffic",)),
    Sign(
        "warning--railroad-crossing-with-barriers",
        _hazard("level_crossing"),
        "A,25",
        "W10-1",
        ("railroad crossing",),
    ),
    Sign("warning--railroad-crossing-without-barriers", _hazard("level_crossing"), "A,26a", "W10-1"),
    Sign("warning--other-danger", _sign("hazard"), "A,32", None, ("other danger",)),
)

_GROUP = re.compile(r"--g\d+$")
_WORDS = re.compile(r"[^a-z0-9{}]+")
_NUMBER = re.compile(r"\d+(?: \d+)?")


def find_sign(class_name: str) -> tuple[Sign, str | None] | None:
    """Return what a class is and the number on it, None where the table does not have it."""
    words = _words(_GROUP.sub("", class_name.lower()))
    if words in _BY_WORDS:
        return _BY_WORDS[words], None
    number = _NUMBER.search(words)
    if number is None:
        return None
    general = (words[: number.start()] + "{}" + words[number.end() :]).strip()
    return (_BY_WORDS[general], number.group().replace(" ", ".")) if general in _BY_WORDS else None


def osm_tags(class_name: str) -> dict[str, str] | None:
    """Return the tags of OpenStreetMap for a class, None where the table does not have it."""
    found = find_sign(class_name)
    if found is None:
        return None
    sign, number = found
    return {key: value.replace("{}", number or "") for key, value in sign.osm.items()}


def is_traffic_light(class_name: str) -> bool:
    """Return whether a class is a traffic light, of whatever kind: `object--traffic-light--general-upright` too."""
    return "traffic light" in _words(class_name.lower()) or _words(class_name.lower()) in ("light", "traffic signal")


def is_for_pedestrians(class_name: str) -> bool:
    """Return whether a class of traffic lights is those of pedestrians: `object--traffic-light--pedestrians`."""
    return "pedestrian" in _words(class_name.lower())


def _words(text: str) -> str:
    return " ".join(_WORDS.sub(" ", text).split())


_BY_WORDS = {_words(name): sign for sign in SIGNS for name in (sign.mapillary, *sign.names)}
for _each in SIGNS:  # Without its kind too, where that is no other's name.
    _BY_WORDS.setdefault(_words(_each.mapillary.split("--", 1)[1]), _each)
