"""Recordings for Rerun's viewer: what is in them, with and without the package."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from report_city import city
from small_dataset import map_of
from valuemap.cameras import camera_centers
from valuemap.dataset import Frame
from valuemap.errors import SettingError
from valuemap.tables import Categories
from valuemap.writers import export_map


@dataclass
class Log:
    """What was logged, by entity."""

    entities: dict[str, Any]
    path: str = ""
    closed: bool = False


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> Log:
    """Return what a stand-in for the package is told; the package itself is half a GB."""
    told = Log({})

    class RecordingStream:
        def __init__(self, application: str, *, recording_id: str) -> None:
            assert application == "valuemap"
            assert recording_id

        def save(self, path: str) -> None:
            told.path = path
            Path(path).write_bytes(b"RRF2")

        def log(self, entity: str, what: Any, *, static: bool) -> None:
            assert static
            told.entities[entity] = what

        def disconnect(self) -> None:
            told.closed = True

    def archetype(*positional: Any, **named: Any) -> SimpleNamespace:
        return SimpleNamespace(data=positional[0] if positional else None, **named)

    directions = {f"RIGHT_HAND_{axis}_{way}": f"{axis} {way}" for axis in "XYZ" for way in ("UP", "DOWN")}
    stand_in = SimpleNamespace(
        RecordingStream=RecordingStream,
        Points3D=archetype,
        Ellipsoids3D=archetype,
        LineStrips3D=archetype,
        ViewCoordinates=SimpleNamespace(**directions),
    )
    monkeypatch.setitem(sys.modules, "rerun", stand_in)
    return told


def test_a_recording_holds_labels_tracks_votes_and_truth(log: Log, tmp_path: Path) -> None:
    evidence = city()
    result, dataset = evidence.result, evidence.dataset
    export_map(result, tmp_path / "map.rrd", dataset=dataset)
    assert log.closed
    assert (tmp_path / "map.rrd").read_bytes() == b"RRF2"
    assert set(log.entities) == {
        "world",
        "world/labels",
        "world/ellipsoids",
        "world/tracks",
        "world/votes",
        "world/truth",
    }
    labels = log.entities["world/labels"]
    assert np.array_equal(labels.data, result.labels.position_in_world_m)
    assert labels.labels[0].startswith(f"{result.labels.label_id[0]}: traffic_light, {result.labels.votes[0]} votes")
    rays = log.entities["world/votes"].data
    assert rays.shape == (len(result.votes), 2, 3)
    assert np.array_equal(rays[:, 0], camera_centers(dataset.images)[evidence.image_row])
    of_label = result.labels.position_in_world_m[np.searchsorted(result.labels.label_id, result.votes.label_id)]
    assert np.array_equal(rays[:, 1], of_label)
    tracks = log.entities["world/tracks"].data
    assert sum(map(len, tracks)) == len(dataset.images)
    assert max(float(np.linalg.norm(np.diff(track, axis=0), axis=1).max(initial=0.0)) for track in tracks) <= 25.0


def test_ellipsoids_are_those_of_the_covariance_and_up_is_that_of_the_frame(log: Log, tmp_path: Path) -> None:
    result = map_of([[1.0, 2.0, 3.0]])
    covariance = np.array([[0.05, 0.04, 0.0, 0.05, 0.0, 0.01]])  # 0.3, 0.1 and 0.1 m, the first to the north-east.
    result = replace(result, labels=result.labels.replace(covariance_m2=covariance), frame=Frame(up=(0.0, -1.0, 0.0)))
    export_map(result, tmp_path / "map.rrd")
    assert log.entities["world"] == "Y DOWN"
    ellipsoid = log.entities["world/ellipsoids"]
    assert np.allclose(np.sort(ellipsoid.half_sizes[0]), 2.7955 * np.array([0.1, 0.1, 0.3]), atol=1e-4)
    x, y, z, w = ellipsoid.quaternions[0]
    assert x**2 + y**2 + z**2 + w**2 == pytest.approx(1.0)
    from scipy.spatial.transform import Rotation

    long = Rotation.from_quat(ellipsoid.quaternions[0]).as_matrix()[:, int(np.argmax(ellipsoid.half_sizes[0]))]
    assert abs(long @ [np.sqrt(0.5), np.sqrt(0.5), 0.0]) == pytest.approx(1.0)
    export_map(map_of(np.empty((0, 3))), tmp_path / "none.rrd")
    assert "world/votes" not in log.entities


def test_without_the_package_one_line_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(SettingError, match="needs the extra named rerun") as caught:
        export_map(map_of([[0.0, 0.0, 0.0]]), tmp_path / "map.rrd")
    assert caught.value.hint == "pip install 'valuemap[rerun]'"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="the extra rerun is not installed")
def test_the_package_takes_what_it_is_given(tmp_path: Path) -> None:
    export_map(city().result, tmp_path / "map.rrd", dataset=city().dataset)
    content = (tmp_path / "map.rrd").read_bytes()
    assert content.startswith(b"RRF2")
    assert b"world/votes" in content


def test_a_label_that_is_gone_says_so(log: Log, tmp_path: Path) -> None:
    result = map_of([[0.0, 0.0, 5.0], [9.0, 0.0, 5.0]])
    states = Categories.from_texts(["gone", "new"])
    export_map(replace(result, labels=result.labels.replace(state=states)), tmp_path / "map.rrd")
    assert log.entities["world/labels"].labels == ["0: light, 5 votes, gone", "1: light, 5 votes, new"]
