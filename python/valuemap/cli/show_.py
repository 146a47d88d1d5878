"""`valuemap show`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from valuemap.anchor import is_place
from valuemap.cli.app import app
from valuemap.cli.options import AsJson, DatasetOfMap, Force, MapFolder
from valuemap.cli.show import log, out, show
from valuemap.dataset import read_dataset
from valuemap.errors import InputError, SettingError
from valuemap.evidence import PICTURES, Evidence, find_dataset
from valuemap.map_folder import read_map
from valuemap.rejected import find_rejected

if TYPE_CHECKING:
    from valuemap.arrays import Floats

_FARTHEST_M = 1e9
"""Of a place that is asked about: farther in metres than anything on the Earth is from the origin of a map."""


@app.command("show")
def show_command(
    map_: MapFolder,
    label: Annotated[int | None, typer.Argument(metavar="[LABEL]", help="Id of a label.", show_default=False)] = None,
    at: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="X Y", help="Say why there is nothing at a place, in the axes of the picture from above."),
    ] = None,
    lat: Annotated[float | None, typer.Option(help="The same place in WGS84 degrees, with --lon.")] = None,
    lon: Annotated[float | None, typer.Option(help="See --lat.")] = None,
    radius: Annotated[
        float | None, typer.Option(min=0.1, help="Metres around the place that count; default: 2.", show_default=False)
    ] = None,
    file: Annotated[
        Path | None, typer.Option("--out", help="Picture to write, .png or .svg; default: label-ID.png or place.png.")
    ] = None,
    dataset: DatasetOfMap = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Show one label as a picture: its votes, the images that missed it, its rays; or why there is none at a place."""
    from valuemap.report.label_sheet import plot_label
    from valuemap.report.place_sheet import RADIUS_M, explain_place, plot_place
    from valuemap.report.style import check_format, save_figure

    asked = [label is not None, at is not None, lat is not None or lon is not None]
    if sum(asked) != 1 or (lat is None) != (lon is None):
        raise SettingError(
            "show: expected a label, or a place as --at X Y or as --lat and --lon",
            hint="for example valuemap show MAP 12, or valuemap show MAP --at 105.2 48.9",
        )
    if label is not None and radius is not None:
        raise SettingError(
            "show: --radius is around a place, not around a label", hint="leave it out, or give --at X Y"
        )
    _check_place(at, lat, lon)
    picture = file if file is not None else Path(f"label-{label}.png" if label is not None else "place.png")
    check_format(picture)
    result = read_map(map_)
    folder = find_dataset(map_, result.run, dataset)
    if folder is None:
        raise InputError(
            f"{map_}: cannot tell which dataset the map was made from", hint="give its folder with --dataset"
        )
    evidence = Evidence(result, read_dataset(folder))
    pictures = folder / PICTURES if (folder / PICTURES).is_dir() else None
    if label is not None:
        facts = _label_facts(evidence, label)
        save_figure(plot_label(evidence, label, pictures), picture, force=force)
        if as_json:
            print(json.dumps(facts, indent=2))
        else:
            show(facts)
    else:
        point = _place(evidence, at, lat, lon)
        rejected = evidence.result.rejected
        if rejected is None:
            rejected = find_rejected(evidence, point)
        answer = explain_place(evidence, point, rejected, radius_m=RADIUS_M if radius is None else radius)
        save_figure(plot_place(evidence, answer, rejected, pictures), picture, force=force)
        if as_json:
            print(json.dumps(answer.to_json(), indent=2))
        else:
            for reason in answer.reasons:
                out.print(reason, markup=False, highlight=False, soft_wrap=True)
    log.print(f"Wrote {picture}", highlight=False, markup=False)


def _label_facts(evidence: Evidence, label: int) -> dict[str, Any]:
    labels, row = evidence.result.labels, evidence.label_row(label)
    voters, misses = evidence.voters(label), evidence.misses(label)
    x, y, z = (float(c) for c in labels.position_in_world_m[row])
    sigma = np.sqrt(np.maximum(labels.stated_covariance_m2[row][[0, 3, 5]], 0.0))
    facts: dict[str, Any] = {
        "label": label,
        "class": labels.class_name.names[labels.class_name.codes[row]],
        "x": x,
        "y": y,
        "z": z,
        "sigma x": float(sigma[0]),
        "sigma y": float(sigma[1]),
        "sigma z": float(sigma[2]),
        "votes": len(voters),
        "passes": len(np.unique(voters.pass_number)),
        "images that should have seen it and did not": len(misses),
        "reprojection rms in px": float(labels.reprojection_rms_px[row]),
    }
    if labels.state is not None:
        facts["state"] = labels.state.names[labels.state.codes[row]]
    if labels.existence is not None:
        facts["existence"] = float(labels.existence[row])
    if labels.lon_lat_height is not None:
        facts |= dict(zip(("lon", "lat", "height"), map(float, labels.lon_lat_height[row]), strict=True))
    return facts


def _check_place(at: tuple[float, float] | None, lat: float | None, lon: float | None) -> None:
    if at is not None and not all(abs(metres) <= _FARTHEST_M for metres in at):
        raise SettingError(
            f"--at {at[0]:g} {at[1]:g}: expected metres, at most {_FARTHEST_M:g} from the origin of the map",
            hint="for example --at 105.2 48.9; valuemap view shows where the map is",
        )
    if lat is not None and lon is not None and not is_place(lat, lon, 0.0):
        raise SettingError(
            f"--lat {lat:g} --lon {lon:g}: expected a latitude from -90 to 90 and a longitude from -360 to 360",
            hint="both are in degrees: for example --lat 51.5 --lon -0.14",
        )


def _place(evidence: Evidence, at: tuple[float, float] | None, lat: float | None, lon: float | None) -> Floats:
    """Return the place in the world, at the height of the cameras around."""
    from valuemap.geodesy import enu_from_lon_lat_height
    from valuemap.report.place_sheet import place_in_world

    if at is None:
        anchor = evidence.result.frame.anchor
        if anchor is None:
            raise InputError(
                "--lat and --lon: the map is not geo-referenced", hint="give the place in metres with --at X Y"
            )
        x, y, _ = enu_from_lon_lat_height(np.array([[lon, lat, anchor[2]]], np.float64), anchor)[0]
        at = (float(x), float(y))
    return place_in_world(evidence, *at)
