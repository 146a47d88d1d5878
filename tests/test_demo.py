"""The demo, with few pictures: from a simulated city over pictures and the bundled model to a map."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

import valuemap
from valuemap import demo
from valuemap.cli.commands import app


def test_the_demo_goes_from_pictures_to_a_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    few = demo.CITY.with_settings(["passes_per_street=0", "images=16"])
    monkeypatch.setattr(demo, "run_demo", partial(demo.run_demo, config=few))
    app(["demo", "--out", str(tmp_path / "demo")], standalone_mode=False)
    told = capsys.readouterr().out
    assert "detection rate at IoU 0.3" in told
    assert "position rmse m" in told
    dataset = valuemap.read_dataset(tmp_path / "demo" / "dataset")
    assert len(list((tmp_path / "demo" / "dataset" / "images").rglob("*.jpg"))) == len(dataset.images) == 16
    assert len(dataset.detections) > 10
    assert len(valuemap.read_map(tmp_path / "demo" / "map").labels) > 0
    assert (tmp_path / "demo" / "map.png").read_bytes().startswith(b"\x89PNG")
