"""Settings of `valuemap train`."""

from __future__ import annotations

from pydantic.dataclasses import dataclass

from valuemap.config.setting import CHECKED, Settings, declare
from valuemap.errors import SettingError


@dataclass(frozen=True, config=CHECKED)
class TrainConfig(Settings):
    """How a segmentation network is built and trained."""

    # The network. Its size on disk and its speed depend on these alone.
    first_stride: int = declare(
        2, unit="px", low=1, high=2, effect="2 works on the picture at half size: four times as fast, coarser boxes"
    )
    first_channels: int = declare(16, unit="channels", low=1, effect="channels of the first convolution")
    growth_channels: int = declare(10, unit="channels", low=1, effect="new channels a layer of a dense block")
    first_layers: int = declare(
        2, unit="layers", low=1, effect="layers of the first and last dense block, at the full size; the dearest"
    )
    layers: int = declare(4, unit="layers", low=1, effect="layers of each other dense block")
    levels: int = declare(
        4, unit="halvings", low=1, high=4, effect="how often a picture is halved and enlarged again; more sees wider"
    )
    compression: float = declare(
        0.6, unit="1", open_low=True, high=1.0, effect="share of the channels that a transition down keeps"
    )
    dropout: float = declare(0.05, unit="1", high=0.9, effect="share of channels left out at random in training")

    # The optimisation.
    epochs: int = declare(40, unit="epochs", low=1, effect="how often the network sees every picture")
    cutouts: int = declare(
        1, unit="cut-outs", low=1, effect="cut-outs of each picture an epoch; more validates and saves less often"
    )
    batch: int = declare(8, unit="pictures", low=1, effect="cut-outs a step; more needs more memory")
    learning_rate: float = declare(
        0.003, unit="1", open_low=True, high=1.0, effect="largest step; rises over the first 5 % and falls to nothing"
    )
    weight_decay: float = declare(0.0005, unit="1", effect="pull of the weights towards 0")
    focal_power: float = declare(
        2.0, unit="1", high=5.0, effect="how little pixels count that are right already; 0 counts all alike"
    )
    small_object_px: float = declare(
        64.0, unit="px", effect="pixels of an object smaller than this count more, so that it counts like one as large"
    )
    validation_share: float = declare(
        0.2,
        unit="1",
        open_low=True,
        high=0.9,
        effect="share of the pictures kept for validation where the labels do not say which",
    )
    minimum_component_px: int = declare(4, unit="px", low=1, effect="connected pixels fewer than this are no detection")

    # The augmentation.
    crop_px: int = declare(
        256, unit="px", low=32, high=4096, effect="side of the square cut-outs, a multiple of 32; larger costs more"
    )
    object_share: float = declare(
        0.7, unit="1", high=1.0, effect="share of cut-outs that hold an object, where the picture has one"
    )
    flip_share: float = declare(0.5, unit="1", high=1.0, effect="share of cut-outs with left and right exchanged")
    max_enlargement: float = declare(
        1.6, unit="1", low=1.0, high=8.0, effect="pictures are enlarged or shrunk by at most this, at random"
    )
    brightness: float = declare(
        0.3, unit="1", high=0.9, effect="brightness, contrast and the balance of colours vary by about this share"
    )
    blur_sigma_px: float = declare(1.0, unit="px", effect="a third of the cut-outs are blurred by up to this")

    def __post_init__(self) -> None:
        if self.crop_px % 32:
            raise SettingError(
                f"crop_px: expected a multiple of 32, found {self.crop_px}", hint="take 256, 320 or 384, say"
            )
