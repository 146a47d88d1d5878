"""What the readers of APIs of street pictures, Mapillary and Panoramax, have in common once an answer is understood."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from valuemap.arrays import Floats
from valuemap.errors import InputError
from valuemap.readers.assemble import FoundBoxes, Imported, assemble
from valuemap.readers.cameras_of import Camera, make_cameras
from valuemap.readers.detections import DetectionFile, read_detections
from valuemap.readers.json_documents import Pages
from valuemap.readers.json_values import Told
from valuemap.readers.poses import make_images, place_on_earth
from valuemap.readers.vet import refuse_too_many_unreadable
from valuemap.tables import Images


@dataclass
class FoundImages:
    """Images and boxes read so far, and what was told of them; an image with an id is named `ID.jpg`.

    Images have `names`, cameras, passes and times (s, NaN where there is none), and `unreadable` says by name why
    others cannot be used. Boxes have the name of their image, a class, left, top, right and bottom, and where they are.
    """

    told: Told = field(default_factory=Told)
    pages: Pages = field(default_factory=Pages)
    names: list[str] = field(default_factory=list)
    cameras: list[Camera] = field(default_factory=list)
    passes: list[str] = field(default_factory=list)
    time: list[float] = field(default_factory=list)
    image_of_box: list[str] = field(default_factory=list)
    classes: list[str] = field(default_factory=list)
    edges: list[list[float]] = field(default_factory=list)
    where: list[str] = field(default_factory=list)
    unreadable: dict[str, str] = field(default_factory=dict)

    def add_image(self, name: str, camera: Camera, drive: str, time_s: float) -> None:
        """Add an image that can be used."""
        self.names.append(name)
        self.cameras.append(camera)
        self.passes.append(drive)
        self.time.append(time_s)

    def add_box(self, image: str, class_name: str, edges: list[float], where: str) -> None:
        """Add a box of an image, by its name, that may not be there."""
        self.image_of_box.append(image)
        self.classes.append(class_name)
        self.edges.append(edges)
        self.where.append(where)

    def refuse_unusable(self, export: Path, max_rejected: float, hint: str, expected: str) -> None:
        """Refuse an export without images, or of which too large a share cannot be used; `hint` says what then helps.

        Raises
        ------
        InputError
            It is so.
        """
        count = len(self.names) + len(self.unreadable)
        refuse_too_many_unreadable(self.unreadable, count, max_rejected, str(export), hint)
        if not self.names:
            raise InputError(f"{export}: there are no images in it", hint=f"expected {expected}")

    def assembled(
        self,
        export: Path,
        *,
        lon_lat_height: Floats,
        local_from_cam: Floats,
        edges_px: Callable[[], Floats],
        score: Floats,
        detections: DetectionFile | Path | None,
        anchor: tuple[float, float, float] | None,
        max_rejected: float,
        tell: Callable[[str], None] | None,
        position_sigma_m: Floats | None = None,
    ) -> Imported:
        """Return the dataset of all that was found.

        Parameters
        ----------
        export
            The file or folder that was read.
        lon_lat_height, local_from_cam
            Of the images: places (N, 3), and rotations (N, 3, 3) from camera axes into east, north, up there.
        edges_px, score
            Of the boxes: returns left, top, right, bottom in pixels of the picture as stored (M, 4); scores (M).
        detections
            As in `read_detections`, instead of the boxes.
        anchor, max_rejected, tell
            As in `place_on_earth` and `assemble`.
        position_sigma_m
            Standard deviations of each axis (N), NaN where not known.
        """
        placed = place_on_earth(lon_lat_height, anchor, self.names, source=str(export), tell=tell)
        cameras, camera_id = make_cameras(self.cameras, str(export))
        images = make_images(
            names=self.names,
            camera_id=camera_id,
            world_from_cam=placed.world_from_local @ local_from_cam,
            center_in_world_m=placed.position_in_world_m,
            passes=self.passes,
            source=str(export),
            timestamp_s=np.array(self.time),
            position_sigma_m=position_sigma_m,
        )
        if detections is not None:
            boxes = read_detections(detections, images, cameras)
        else:
            boxes = self._boxes(images, edges_px(), score) if self.edges else FoundBoxes.none()
        return assemble(
            name=export.stem,
            cameras=cameras,
            images=images,
            detections=boxes,
            up=None,
            anchor=placed.anchor,
            is_on_earth=True,
            source=str(export),
            max_rejected=max_rejected,
            unreadable=self.unreadable,
        )

    def _boxes(self, images: Images, edges_px: Floats, score: Floats) -> FoundBoxes:
        row_of = {name: row for row, name in enumerate(images.name.to_pylist())}
        return FoundBoxes(
            image_row=np.array([row_of.get(name, -1) for name in self.image_of_box], dtype=np.int64),
            class_names=self.classes,
            center_px=(edges_px[:, :2] + edges_px[:, 2:]) / 2.0,
            size_px=edges_px[:, 2:] - edges_px[:, :2],
            score=score,
            where=self.where.__getitem__,
            image_names=self.image_of_box,
        )
