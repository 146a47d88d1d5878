"""`valuemap evaluate`."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from valuemap.cli.app import app
from valuemap.cli.options import AsJson, MapFolder, Radius, SeenWithin, TruthSigma
from valuemap.cli.show import evaluation_rows, show, show_notes
from valuemap.evaluate import ChanceFloor, Evaluation, PositionalAccuracy, evaluate_map
from valuemap.map_folder import read_map


@app.command("evaluate")
def evaluate_command(
    map_: MapFolder,
    truth: Annotated[Path, typer.Option(help="A dataset with truth, or a file of objects with x, y, z.")],
    radius: Radius = 2.0,
    truth_sigma: TruthSigma = None,
    images: Annotated[
        Path | None, typer.Option(metavar="DATASET", help="The dataset of the map, where the truth is a file.")
    ] = None,
    seen_within: SeenWithin = None,
    as_json: AsJson = False,
) -> None:
    """Compare a map with known objects: counts, an accuracy statement, completeness, and what chance would give."""
    evaluation = evaluate_map(
        read_map(map_),
        truth,
        radius_m=radius,
        truth_sigma_m=truth_sigma,
        images=images,
        seen_within_m=seen_within,
    )
    if as_json:
        print(json.dumps(evaluation.to_json(), indent=2))
    else:
        show(evaluation_rows(evaluation))
        _show_statement(evaluation)
    show_notes(evaluation.notes)


def _show_statement(evaluation: Evaluation) -> None:
    """Print what a surveyor wants to know."""
    accuracy, chance = evaluation.accuracy, evaluation.chance
    if accuracy.check_points:
        show(_accuracy_rows(accuracy), title="Accuracy")
        print(f"{accuracy.statement[0].upper()}{accuracy.statement[1:]}.")
    show(evaluation.completeness.to_json(), title="Completeness")
    show({f"matches, truth moved {chance.shift_m:g} m": chance.matches, **_chance_rows(chance)}, title="Chance")
    if evaluation.reliability:
        rows = {
            f"{r.low:g} to {r.high:g}": f"{r.true_share:.3f} of {r.labels} true, said {r.mean_existence:.3f}"
            for r in evaluation.reliability
        }
        show(rows, title="Existence")


def _accuracy_rows(accuracy: PositionalAccuracy) -> dict[str, str]:
    """Return the figures that there are, those of one kind in one line."""
    lines = {
        "RMSE east, north, up in m": (accuracy.rmse_east_m, accuracy.rmse_north_m, accuracy.rmse_up_m),
        "bias east, north, up in m": (accuracy.bias_east_m, accuracy.bias_north_m, accuracy.bias_up_m),
        "sigma east, north, up in m": (accuracy.sigma_east_m, accuracy.sigma_north_m, accuracy.sigma_up_m),
        "RMSE_H, RMSE_V, RMSE_3D in m": (accuracy.rmse_h_m, accuracy.rmse_v_m, accuracy.rmse_3d_m),
        "NSSDA 95 % horizontal, vertical in m": (accuracy.nssda_horizontal_95_m, accuracy.nssda_vertical_95_m),
        "share in 95 % ellipse, and less bias": (accuracy.in_95_ellipse, accuracy.in_95_ellipse_less_bias),
        "share in 95 % height, and less bias": (accuracy.in_95_height, accuracy.in_95_height_less_bias),
        "factor for honest sigmas": (accuracy.stated_sigma_factor,),
    }
    known = {name: [value for value in values if not math.isnan(value)] for name, values in lines.items()}
    told = {name: "  ".join(f"{value:.3f}" for value in values) for name, values in known.items() if values}
    return {"check points": str(accuracy.check_points), **told}


def _chance_rows(chance: ChanceFloor) -> dict[str, float]:
    return {name: value for name in ("precision", "recall") if not math.isnan(value := getattr(chance, name))}
