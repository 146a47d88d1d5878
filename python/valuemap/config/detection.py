"""Settings of `valuemap detect`."""

from __future__ import annotations

from typing import Literal

from pydantic.dataclasses import dataclass

from valuemap.config.setting import CHECKED, Settings, declare
from valuemap.errors import SettingError

MAX_CANVAS_PX = 2**26
"""What goes through a network at once: its layers take hundreds of bytes a pixel."""

ModelKind = Literal["segmentation", "yolox", "yolov5", "ultralytics", "rtdetr", "detr", "boxes"]
Provider = Literal["cpu", "cuda"]


@dataclass(frozen=True, config=CHECKED)
class DetectConfig(Settings):
    """How pictures are put through a detector, and which of its boxes count."""

    kind: ModelKind | None = None
    """What the outputs of the model mean; None finds out."""
    classes: str = ""
    """Names or numbers of the wanted classes, each perhaps =NEW_NAME, with commas between; none is all."""
    size: str = "model"
    """What the network sees: "model" is its own size, else the picture's; "picture"; N or WIDTHxHEIGHT in px."""
    provider: Provider = "cpu"
    min_score: float | None = None
    """A box with a lower score is dropped; None takes the model's own, or `default_min_score`."""
    default_min_score: float = declare(
        0.3, unit="1", high=1.0, effect="a box with a lower score is dropped, if --min-score does not say otherwise"
    )
    max_iou: float = declare(
        0.5, unit="1", high=1.0, effect="of two boxes of one class that overlap more than this, the lesser is dropped"
    )
    tile_px: int = declare(
        0,
        unit="px",
        effect="larger pictures are cut into overlapping tiles of this size, to find smaller things; 0 cuts nothing",
    )
    tile_overlap_px: int = declare(
        96,
        unit="px",
        effect="least overlap of two tiles: things larger than this may be seen only in parts, then joined",
    )
    batch: int = declare(
        1, unit="pictures", low=1, high=1024, effect="pictures of one size that go through the network together"
    )
    decoders: int = declare(
        0, unit="threads", high=256, effect="threads that decode pictures ahead of the network; 0 for one per core"
    )
    panorama_view_deg: float = declare(
        90.0,
        unit="deg",
        low=30.0,
        high=120.0,
        effect="field of view of the perspective views, all the way round, that a panorama is cut into",
    )
    panorama_overlap_deg: float = declare(
        20.0, unit="deg", high=25.0, effect="least overlap of two neighbouring views of a panorama"
    )
    panorama_pitch_deg: float = declare(
        10.0, unit="deg", low=-60.0, high=60.0, effect="how far the views of a panorama look up"
    )

    def __post_init__(self) -> None:
        if self.min_score is not None and not 0.0 <= self.min_score <= 1.0:
            raise SettingError(f"--min-score: expected 0 to 1, found {self.min_score}", hint="for example 0.3")
        if self.tile_px and self.tile_overlap_px >= self.tile_px / 2:
            raise SettingError(
                f"--tile {self.tile_px}: expected more than twice tile_overlap_px ({self.tile_overlap_px})",
                hint="take larger tiles, or --set tile_overlap_px=32",
            )
        _ = self.size_px

    @property
    def size_px(self) -> tuple[int, int] | None:
        """The width and height that the user asked for; None for the model's or the picture's own."""
        if self.size in ("model", "picture"):
            return None
        sides = self.size.lower().split("x")
        if len(sides) > 2 or not all(side.isdecimal() and 0 < int(side) < 2**15 for side in sides):
            raise SettingError(
                f"--size: expected N or WIDTHxHEIGHT in px, or picture, found {self.size!r}",
                hint="for example --size 1024x448",
            )
        width, height = int(sides[0]), int(sides[-1])
        if width * height * self.batch > MAX_CANVAS_PX:
            raise SettingError(
                f"--size {self.size}: {width} x {height} px in batches of {self.batch} do not fit into memory",
                hint=f"take at most {MAX_CANVAS_PX // 10**6} million pixels at once, and --tile for small things",
            )
        return width, height
