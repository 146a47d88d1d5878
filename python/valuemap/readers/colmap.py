"""COLMAP models, text and binary, with or without rigs."""

from __future__ import annotations

import codecs
import tempfile
from pathlib import Path, PurePosixPath

import numpy as np
import pyarrow as pa

from valuemap.arrays import Ints
from valuemap.colmap import pycolmap
from valuemap.errors import InputError
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, ONE_PASS, Imported, assemble
from valuemap.readers.colmap_files import copy_without_points, find_model, has_mark
from valuemap.readers.csv_file import CsvFile
from valuemap.readers.detections import DetectionFile, read_detections
from valuemap.readers.files import refuse_repeated_names
from valuemap.readers.names import match_images
from valuemap.readers.reader import Reader
from valuemap.tables import Cameras, Categories, Images

_LARGEST_PX = 2**31
_EXPECTED_PASSES = "a CSV file with columns image and pass"


@Reader
def read_colmap(
    model_dir: Path,
    *,
    detections: DetectionFile | Path | None = None,
    pass_from: str = "folder",
    up: tuple[float, float, float] | None = None,
    anchor: tuple[float, float, float] | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
) -> Imported:
    """Read a COLMAP model and the detections in its images.

    Camera, image and pose conventions of valuemap are COLMAP's own, so numbers and ids are taken as they are.
    Images without a pose are left out, as COLMAP's own exports do.

    Parameters
    ----------
    model_dir
        Folder with cameras, images and, where both exist, rigs and frames, as .bin (preferred) or .txt.
    detections
        As in `read_detections`; None where they are still to be found in the pictures.
    pass_from
        "folder" (the folder part of the image name is its pass), "none" (all images are one pass), or the
        path of a CSV file with columns image and pass.
    up, anchor, max_rejected
        As in `assemble`.

    Raises
    ------
    InputError
        A file is missing, damaged or inconsistent with the others.
    SettingError
        `up`, `anchor` or `max_rejected` is impossible.
    """
    progress("reading the COLMAP model", 0, 2)
    cameras, images = _read_model(model_dir, pass_from)
    progress("reading the detections", 1, 2)
    dataset = assemble(
        name=model_dir.resolve().name,
        cameras=cameras,
        images=images,
        detections=read_detections(detections, images, cameras),
        up=up,
        anchor=anchor,
        source=str(model_dir),
        max_rejected=max_rejected,
    )
    progress("reading the detections", 2, 2)
    return dataset


def _read_model(model_dir: Path, pass_from: str) -> tuple[Cameras, Images]:
    model = _load(find_model(model_dir), model_dir)
    cameras = [model.cameras[camera_id] for camera_id in sorted(model.cameras)]
    images = [model.images[image_id] for image_id in sorted(model.images) if model.images[image_id].has_pose]
    if not images:
        raise InputError(
            f"{model_dir}: the model has no image with a pose",
            hint="is this the folder of a finished reconstruction?",
        )
    names = [image.name for image in images]
    for camera in cameras:
        if not 0 < max(camera.width, camera.height) < _LARGEST_PX:
            raise InputError(
                f"{model_dir}: camera {camera.camera_id}: {camera.width} x {camera.height} px is no size of a picture",
                hint="is the file whole? Export the model again",
            )
    return (
        Cameras(
            camera_id=np.array([camera.camera_id for camera in cameras], dtype=np.int64),
            model=Categories.from_texts([camera.model.name for camera in cameras]),
            width_px=np.array([camera.width for camera in cameras], dtype=np.int64),
            height_px=np.array([camera.height for camera in cameras], dtype=np.int64),
            params=[np.array(camera.params, dtype=np.float64) for camera in cameras],
        ),
        _with_poses(images, names, Categories.from_texts(_passes(names, pass_from)), model_dir),
    )


def _load(files: list[Path], model_dir: Path) -> pycolmap.Reconstruction:
    """Read the files through a folder that has no points: they are not needed, and may be many."""
    suffix = files[0].suffix
    with tempfile.TemporaryDirectory() as folder:
        for path in files:
            if path.name == "images.bin":
                copy_without_points(path, Path(folder) / path.name)
            elif path.suffix == ".txt" and has_mark(path):
                (Path(folder) / path.name).write_bytes(path.read_bytes().removeprefix(codecs.BOM_UTF8))
            else:
                (Path(folder) / path.name).symlink_to(path.resolve())
        (Path(folder) / f"points3D{suffix}").write_bytes(bytes(8) if suffix == ".bin" else b"")
        try:
            model = pycolmap.Reconstruction(folder)
            for image in model.images.values():
                _ = image.name  # Fails where it is not UTF-8.
        except Exception as error:  # pybind11 gives what C++ throws many types.
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(
                f"{model_dir}: pycolmap cannot read {', '.join(path.name for path in files)}: {reason}",
                hint="does COLMAP's own model_analyzer read it? If not, export it again",
            ) from error
    return model


def _with_poses(images: list[pycolmap.Image], names: list[str], pass_id: Categories, model_dir: Path) -> Images:
    poses = [image.cam_from_world() for image in images]
    quaternion = np.array([pose.rotation.quat for pose in poses])[:, [3, 0, 1, 2]]  # pycolmap: x, y, z, w.
    translation_m = np.array([pose.translation for pose in poses])
    refuse_repeated_names(names, str(model_dir))
    return Images(
        image_id=np.array([image.image_id for image in images], dtype=np.int64),
        name=pa.array(names, pa.string()),
        camera_id=np.array([image.camera_id for image in images], dtype=np.int64),
        cam_from_world_quat=quaternion,
        cam_from_world_m=translation_m,
        pass_id=pass_id,
        rig_id=_rigs(images),
    )


def _rigs(images: list[pycolmap.Image]) -> Ints | None:
    """Return the frame of each image (N), where a frame has several: they are of one rig at one time."""
    frame = np.array([image.frame_id for image in images], dtype=np.int64)
    return frame if len(np.unique(frame)) < len(frame) else None


def _passes(names: list[str], pass_from: str) -> list[str]:
    if pass_from == "none":
        return [ONE_PASS] * len(names)
    if pass_from == "folder":
        return [folder if (folder := str(PurePosixPath(name).parent)) != "." else ONE_PASS for name in names]
    path = Path(pass_from)
    if not path.is_file():
        raise InputError(
            f"pass-from: expected folder, none or a CSV file, found {pass_from!r}: no such file",
            hint="a CSV file has the columns image and pass",
        )
    table = CsvFile(path, _EXPECTED_PASSES, texts=("image", "pass"), numbers=())
    pass_of: dict[str, str] = {}
    for image, name in zip(table.texts("image"), table.texts("pass"), strict=True):
        if pass_of.setdefault(image, name) != name:
            raise InputError(
                f"{path}: image {image!r} is in two passes, {pass_of[image]!r} and {name!r}",
                hint="give every image one line",
            )
    listed = list(pass_of)
    found = match_images(names, listed)
    missing = [name for name in names if name not in found]
    if missing:
        raise InputError(
            f"{path}: image {missing[0]!r} of the model is not in it ({len(missing)} of {len(names)} images)",
            hint="list every image of the model with its pass",
        )
    return [pass_of[listed[found[name]]] for name in names]
