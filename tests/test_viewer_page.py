"""The page in a browser: labels drawn, clicked, rejected and still rejected after a new map; nothing else is asked."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from PIL import Image

from browser import in_browser, require_browser
from test_viewer import Client, serve
from valuemap.viewer.scene import Scene
from viewer_city import HOSTILE, write_city


def test_what_is_rejected_stays_rejected(tmp_path: Path) -> None:
    require_browser()
    before = write_city(tmp_path, "one")
    row = int(np.argmax(before.labels.votes))
    label_id, place = int(before.labels.label_id[row]), before.labels.position_in_world_m[row]
    for client in serve(lambda: Scene(tmp_path / "map"), tmp_path / "map" / "review.json"):
        first = in_browser("review.mjs", client.server.address, "reject", label_id, tmp_path / "shot.png")
        assert first["drawn"] == len(before.labels)
        _check_drawn(tmp_path / "shot.png", first["at"])
        assert first["thumbs"] >= before.labels.votes[row]
        assert first["crops"] >= 1
        assert " px · " in first["first"]
        assert "1 of" in first["first"]
        assert "2 of" in first["second"]
        assert first["pressed"] == "true"
        assert first["heading"] == "Why is there nothing here?"
        assert "keeps no rejected hypotheses" in first["answer"]
        assert first["sameView"] == f"#{urlsplit(first['address']).fragment}"
        assert "token" not in first["address"]
        _check_texts_and_requests(first, client)
        assert first["sub"].startswith(HOSTILE)

        after = write_city(tmp_path, "one", "two")
        moved = np.linalg.norm(after.labels.position_in_world_m - place, axis=1)
        again_id = int(after.labels.label_id[np.argmin(moved)])
        assert after.labels.votes[np.argmin(moved)] > before.labels.votes[row]
        again = in_browser("review.mjs", client.server.address, "again", again_id, tmp_path / "again.png")
        assert (again["state"], again["review"]) == ("rejected", "rejected")
        assert again["alert"] == []
        assert again["hidden"]
        assert again["note"].startswith('"><img')
        _check_texts_and_requests(again, client)


def _check_texts_and_requests(seen: dict[str, Any], client: Client) -> None:
    """Texts of users are shown as texts, and all requests are to the server itself."""
    assert seen["title"] == seen["pwned"] == "<b>street</b> - valuemap"
    assert seen["scripts"] == 0
    assert HOSTILE in seen["texts"]
    asked = {urlsplit(url).netloc for url in seen["noted"]["requests"] if not url.startswith(("data:", "blob:"))}
    assert asked == {f"127.0.0.1:{client.server.port}"}
    assert seen["noted"]["complaints"] == [], "the browser complains, of the policy for example"


def _check_drawn(screenshot: Path, at: list[float]) -> None:
    """A label is a saturated dot on a pale ground."""
    pixels = np.asarray(Image.open(screenshot).convert("RGB")).astype(int)
    x, y = (round(c) for c in at)
    around = pixels[y - 3 : y + 4, x - 3 : x + 4].reshape(-1, 3)
    assert np.max(np.ptp(around, axis=1)) > 90, "there is no colour where the label should be"
