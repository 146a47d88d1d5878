"""The page in a browser: labels drawn, clicked, rejected and still rejected after a new map; nothing else is asked."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

import valuemap
from browser import in_browser, require_browser
from test_viewer import Client, command, serve
from valuemap.map_folder import write_map
from valuemap.viewer.scene import Scene
from viewer import made_up_city
from viewer_city import HOSTILE, part, write_city


def test_what_is_rejected_stays_rejected(tmp_path: Path) -> None:
    require_browser()
    before = write_city(tmp_path, "one")
    row = int(np.argmax(before.labels.votes))
    label_id, place = int(before.labels.label_id[row]), before.labels.position_in_world_m[row]
    for client in serve(lambda: Scene(tmp_path / "map"), tmp_path / "map" / "review.json"):
        first = in_browser("review.mjs", client.server.address, "reject", label_id, tmp_path / "shot.png")
        assert first["drawn"] == len(before.labels)
        _check_drawn(tmp_path / "shot.png", first["at"])
        assert first["hidden"]
        assert first["asked"] == 1
        assert first["thumbs"] >= before.labels.votes[row]
        assert first["crops"] >= 1
        assert " px · " in first["first"]
        assert "1 of" in first["first"]
        assert "2 of" in first["second"]
        assert first["pressed"] == "true"
        assert first["heading"] == "Why is there nothing here?"
        assert "No rejected hypothesis" in first["answer"] or "It was rejected: " in first["answer"]
        assert first["sameView"] == f"#{urlsplit(first['address']).fragment}"
        assert "token" not in first["address"]
        _check_moved(first, before, client)
        _check_texts_and_requests(first, client)
        assert first["unnamed"] == [], "a screen reader has nothing to say about them"
        assert first["sub"].startswith(HOSTILE)

        after = write_city(tmp_path, "one", "two")
        moved = np.linalg.norm(after.labels.position_in_world_m - place, axis=1)
        again_id = int(after.labels.label_id[np.argmin(moved)])
        assert after.labels.votes[np.argmin(moved)] > before.labels.votes[row]
        again = in_browser("review.mjs", client.server.address, "again", again_id, tmp_path / "again.png")
        assert (again["state"], again["review"]) == ("rejected", "rejected")
        assert again["alert"] == []
        assert again["hidden"]
        others = after.labels.take(after.labels.label_id != again_id)
        assert again["filtered"] == {
            "votes": int(np.sum(others.votes >= int(again["votes ≥ at"]))),
            "existence": 0,
            "passes": int(np.sum(others.passes >= int(again["passes ≥ at"]))),
            "class": 0,
            "all": len(others),
        }
        assert again["filtered"]["votes"] < len(others)
        assert again["note"].startswith('"><img')
        assert again["phone"] == {"beyond": 0, "list": [False, True, False]}
        # One list of triangles for all labels, one for all tracks; the street that both passes drove is drawn once.
        # Around what is selected is a mark; where it was moved to another one, and a line between them.
        for seen, labels, marks in ((first, len(before.labels), 3), (again, len(others), 1)):
            track, street = 1, 1
            assert (seen["far"]["instances"], seen["far"]["all"]) == (0, 6 * (labels + track + street))
            moved = seen["far"]["moved"]
            assert (moved["pictures"], moved["painted"], moved["screen"]) == (1, 0, 6 * marks)
        _check_texts_and_requests(again, client)


def test_many_labels_and_images_are_painted_in_small_steps(tmp_path: Path) -> None:
    """No frame paints more than 16 parts of 512 shapes, of any map, and somebody who moves the map repaints nothing."""
    require_browser()
    dataset, result = made_up_city(12_000, 80_000, 20)
    valuemap.write_dataset(dataset, tmp_path / "dataset")
    write_map(result, tmp_path / "map")
    # A line has 20 bytes at each of four corners, a disc 16. Uniforms are little.
    corners, most = 16 * 512 * 6, 16 * 512 * 4 * 20 + 100_000
    for client in serve(lambda: Scene(tmp_path / "map"), tmp_path / "map" / "review.json"):
        seen = in_browser("levels.mjs", client.server.address, -4.5, -3.0, -1.0, 2.0)
        assert seen["noted"]["complaints"] == []
        steps = [seen["opened"], *seen["first"], seen["hidden"]]
        assert max(step["most"] for step in steps) < most
        assert max(step["all"] for step in seen["first"]) > most, "the map is too small to tell"
        for step in [*seen["first"], *seen["again"], seen["hidden"]]:
            frame = step["frame"]
            assert (frame["instances"], frame["moved"]["painted"], frame["moved"]["screen"]) == (0, 0, 0)
            assert frame["moved"]["pictures"] == 1
            assert frame["most"] <= corners
        drawn = [step["frame"]["all"] for step in seen["first"]]
        assert drawn[0] > corners, "the map is too small to tell"
        assert drawn[0] >= 6 * len(result.labels), "every label is painted"
        assert drawn[1] < 6 * (len(result.labels) + 6_000), "a straight street is a few lines, not one every 12 m"
        assert drawn[-1] < max(drawn), "what is out of view is not drawn"
        assert drawn[-1] < 60_000, "parts are small: from near they reach little beyond the view"
        assert 0 < seen["hidden"]["frame"]["all"] < drawn[0]
        _check_moved_picture(client.server.address, tmp_path)


def _check_moved_picture(address: str, folder: Path) -> None:
    """The ground that was moved looks like ground that is painted where it was moved to."""
    shots = [folder / f"{name}.png" for name in ("before", "moved", "painted")]
    seen = in_browser("moved.mjs", address, 60, *shots)
    assert seen["painted"] == 0 < seen["paintedAnew"]
    first, second, rested = seen["zoomed"]
    assert first == second == 0 < rested
    before, moved, painted = (np.asarray(Image.open(path).convert("RGB")).astype(int) for path in shots)
    assert np.mean(np.any(before != painted, axis=2)) > 0.02
    assert np.mean(np.max(np.abs(moved - painted), axis=2) > 8) < 0.001


def test_the_page_of_the_demo(tmp_path: Path) -> None:
    """As somebody does who tries it: map, look, reject, drive again, map again; with the commands."""
    require_browser()
    demo = os.environ.get("DEMO_FOLDER", "")
    if not demo:
        pytest.skip("the page of the demo is not tried: make demo, and give its folder as DEMO_FOLDER")
    # What the detector found is judged elsewhere: the truth of detections is not that of a part of them.
    whole = dataclasses.replace(valuemap.read_dataset(Path(demo) / "dataset"), truth_detections=None)
    passes = sorted(set(whole.images.pass_id.texts()))
    pictures = Path(demo) / "dataset" / "images"
    half = part(whole, *passes[: len(passes) // 2])
    before = _map_by_command(half, tmp_path)
    place = before.labels.position_in_world_m
    apart = np.linalg.norm(place[:, None] - place, axis=2) + 1e9 * np.eye(len(place))
    row = int(np.argmax(apart.min(axis=1)))
    line = [sys.executable, "-m", "valuemap", "view", str(tmp_path / "map"), "--images", str(pictures), "--no-open"]
    running = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert running.stdout is not None
        address = running.stdout.readline().strip()
        label_id = int(before.labels.label_id[row])
        first = in_browser("review.mjs", address, "reject", label_id, tmp_path / "shot.png")
        assert first["drawn"] == len(before.labels)
        outcomes = set(valuemap.evaluate_map(before, half).matches.object_outcome.texts())
        told = {"found": "true object", "missed": "missed", "not recoverable": "not recoverable"}
        assert {told[each] for each in outcomes} == set(told.values()) & set(first["legend"]), "what there is of truth"
        assert first["crops"] >= 1
        assert first["heading"] == "Why is there nothing here?"
        assert len(first["answer"]) > 40
        after = _map_by_command(whole, tmp_path)
        again_id = int(
            after.labels.label_id[np.argmin(np.linalg.norm(after.labels.position_in_world_m - place[row], axis=1))]
        )
        again = in_browser("review.mjs", address, "again", again_id, tmp_path / "again.png")
        # A label with twice the votes comes back as a question; either way it is out of what is exported.
        shown = {"rejected": "rejected", "check again": "please check again"}
        assert again["review"] == shown[again["state"]]
        for seen in (first, again):
            asked = {
                urlsplit(url).netloc for url in seen["noted"]["requests"] if not url.startswith(("data:", "blob:"))
            }
            assert asked == {urlsplit(address).netloc}
            assert seen["noted"]["complaints"] == []
    finally:
        running.terminate()
        running.communicate(timeout=60)
    done = command("export", tmp_path / "map", tmp_path / "labels.csv", "--reviewed")
    assert done.returncode == 0, done.stderr
    assert len((tmp_path / "labels.csv").read_text().splitlines()) == len(after.labels)


def _map_by_command(dataset: valuemap.Dataset, folder: Path) -> valuemap.Map:
    valuemap.write_dataset(dataset, folder / "dataset")
    done = command("map", folder / "dataset", "--out", folder / "map")
    assert done.returncode == 0, done.stderr
    return valuemap.read_map(folder / "map")


def _check_texts_and_requests(seen: dict[str, Any], client: Client) -> None:
    """Texts of users are shown as texts, and all requests are to the server itself."""
    assert seen["title"] == seen["pwned"] == "<b>street</b> - valuemap"
    assert seen["scripts"] == 0
    assert HOSTILE in seen["texts"]
    assert _asked(seen) == {f"127.0.0.1:{client.server.port}"}
    assert seen["noted"]["complaints"] == [], "the browser complains, of the policy for example"


def _check_moved(seen: dict[str, Any], result: valuemap.Map, client: Client) -> None:
    """The label that was accepted stands where the click was, at its own height."""
    decisions = json.loads(client.server.content.opinions.path.read_text())["decisions"]
    (decision,) = (each for each in decisions if each["label_id"] == seen["nextId"])
    (row,) = np.flatnonzero(result.labels.label_id == seen["nextId"])
    places = np.array([decision["new_position_m"], result.labels.position_in_world_m[row]])
    moved_to, was_at = client.server.content.scene.local(places)
    pixel_m = seen["movedM"][0] / 6.0
    np.testing.assert_allclose(moved_to - was_at, [*seen["movedM"], 0.0], atol=pixel_m)
    assert decision["verdict"] == "accepted"


def _asked(seen: dict[str, Any]) -> set[str]:
    """Return whom the page asked for something."""
    return {urlsplit(url).netloc for url in seen["noted"]["requests"] if not url.startswith(("data:", "blob:"))}


def _check_drawn(screenshot: Path, at: list[float]) -> None:
    """A label is a saturated dot on a pale ground."""
    pixels = np.asarray(Image.open(screenshot).convert("RGB")).astype(int)
    x, y = (round(c) for c in at)
    around = pixels[y - 3 : y + 4, x - 3 : x + 4].reshape(-1, 3)
    assert np.max(np.ptp(around, axis=1)) > 90, "there is no colour where the label should be"
