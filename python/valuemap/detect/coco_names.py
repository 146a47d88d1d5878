"""The names of COCO's classes, for detectors trained on COCO that do not say them."""

from __future__ import annotations

COCO_80 = tuple(
    """person,bicycle,car,motorcycle,airplane,bus,train,truck,boat,traffic light,fire hydrant,stop sign,parking meter,
bench,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe,backpack,umbrella,handbag,tie,suitcase,frisbee,skis,
snowboard,sports ball,kite,baseball bat,baseball glove,skateboard,surfboard,tennis racket,bottle,wine glass,cup,fork,
knife,spoon,bowl,banana,apple,sandwich,orange,broccoli,carrot,hot dog,pizza,donut,cake,chair,couch,potted plant,bed,
dining table,toilet,tv,laptop,mouse,remote,keyboard,cell phone,microwave,oven,toaster,sink,refrigerator,book,clock,
vase,scissors,teddy bear,hair drier,toothbrush""".replace("\n", "").split(",")
)

_NUMBERS_WITHOUT_CLASS = (0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83)


def _with_gaps() -> tuple[str, ...]:
    names = iter(COCO_80)
    return tuple(f"class-{i}" if i in _NUMBERS_WITHOUT_CLASS else next(names) for i in range(91))


COCO_91 = _with_gaps()
"""By COCO's own category ids, 1 to 90 with gaps, as DETR and torchvision count them."""
