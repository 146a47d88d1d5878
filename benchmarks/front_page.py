"""The pictures of the front page: rendered images of the demo with what was detected and where the labels project.

    valuemap demo --out demo && python benchmarks/front_page.py demo docs/images/renders.png

Boxes are detections, crosses are labels of the map that project into the image; a label at a box is what it votes for.
The images are those with the most labels, each of another pass, so of another time of day or weather.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from valuemap.dataset import read_dataset
from valuemap.evidence import PICTURES, Evidence
from valuemap.map_folder import read_map

BOX, CROSS, SHADE = (255, 208, 0), (0, 224, 255), (0, 0, 0)
HEIGHT_PX, GAP_PX, SCALE = 330, 6, 2


def main() -> None:
    """Draw the pictures into one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("demo", type=Path, help="folder that valuemap demo wrote")
    parser.add_argument("out", type=Path)
    parser.add_argument("--columns", type=int, default=3)
    parser.add_argument("--colors", type=int, default=256)
    given = parser.parse_args()
    dataset = read_dataset(given.demo / "dataset")
    evidence = Evidence(read_map(given.demo / "map"), dataset)
    drawn = [
        _drawn(evidence, int(row), given.demo / "dataset" / PICTURES) for row in _best_images(evidence, given.columns)
    ]
    width = sum(each.width for each in drawn) + GAP_PX * (len(drawn) - 1)
    sheet = Image.new("RGB", (width, HEIGHT_PX), "white")
    left = 0
    for each in drawn:
        sheet.paste(each, (left, 0))
        left += each.width + GAP_PX
    given.out.parent.mkdir(parents=True, exist_ok=True)
    sheet.quantize(given.colors, method=Image.Quantize.MAXCOVERAGE).save(given.out, optimize=True)
    print(f"{given.out}: {given.out.stat().st_size / 1000:.0f} kB")


def _best_images(evidence: Evidence, count: int) -> list[int]:
    """Return the rows of the images whose votes are the most and the largest, one per pass."""
    area = np.prod(evidence.dataset.detections.size_px[evidence.detection_row], axis=1)
    images = len(evidence.dataset.images)
    worth = np.bincount(evidence.image_row, np.minimum(area, 900.0), images)
    best: list[int] = []
    for row in np.argsort(-worth, kind="stable"):
        if all(evidence.pass_number[row] != evidence.pass_number[other] for other in best):
            best.append(int(row))
        if len(best) == count:
            break
    return best


def _drawn(evidence: Evidence, row: int, pictures: Path) -> Image.Image:
    with Image.open(pictures / evidence.image_name(row)) as stored:
        picture = stored.convert("RGB").resize((stored.width * SCALE, stored.height * SCALE), Image.Resampling.BICUBIC)
    pen = ImageDraw.Draw(picture)
    detections = evidence.dataset.detections
    for found in evidence.detections_of_image(row):
        (x, y), (w, h) = SCALE * detections.center_px[found], SCALE * detections.size_px[found] + 8.0
        for grow, color, line in ((2, SHADE, 8), (0, BOX, 4)):
            pen.rectangle(
                (x - w / 2 - grow, y - h / 2 - grow, x + w / 2 + grow, y + h / 2 + grow), outline=color, width=line
            )
    labels = evidence.result.labels
    voted = np.unique(evidence.result.votes.label_id[evidence.image_row == row])
    for point in labels.position_in_world_m[np.isin(labels.label_id, voted)]:
        x, y = SCALE * evidence.project(np.array([row]), point)[0]
        for color, line in ((SHADE, 9), (CROSS, 4)):
            pen.line((x - 16, y, x + 16, y), fill=color, width=line)
            pen.line((x, y - 16, x, y + 16), fill=color, width=line)
    width = round(picture.width * HEIGHT_PX / picture.height)
    return picture.resize((width, HEIGHT_PX), Image.Resampling.LANCZOS)


if __name__ == "__main__":
    main()
