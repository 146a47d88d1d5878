"""ROS bags, of ROS 1 and 2, read without ROS: camera info, poses or tf, and 2D detections of vision_msgs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from valuemap.arrays import Floats
from valuemap.errors import InputError, SettingError
from valuemap.progress import Progress, silent
from valuemap.readers.assemble import MAX_REJECTED, STILL_M, FoundBoxes, Imported, assemble
from valuemap.readers.cameras_of import Camera, make_cameras
from valuemap.readers.detections import DetectionFile, read_detections
from valuemap.readers.pixel_center import shift_to_corner_px
from valuemap.readers.poses import (
    images_without_poses,
    make_images,
    nanoseconds_of_gap,
    rigs_by_time,
)
from valuemap.readers.reader import Reader
from valuemap.readers.ros_frames import Frames
from valuemap.tables import Images

_EXPECTED = "a bag of ROS 1 (.bag) or ROS 2 (a folder with metadata.yaml, or .mcap)"
_NANO = 1e-9
_CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_DETECTIONS = "vision_msgs/msg/Detection2DArray"
_TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""The second is what ROS 1 had first; both are a list of transforms."""
_POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
)
_FISHEYES = ("equidistant", "fisheye")

# Definitions that ROS 2 bags may leave out: names and types of fields are the interface, as of vision_msgs 4.
_VISION_MSGS = {
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
    "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
    "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/Detection2D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox2D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections\n",
}


@dataclass
class _Bag:
    """What has been found in the bags."""

    frames: Frames
    cameras: dict[str, Camera] = field(default_factory=dict)
    exposures: list[tuple[str, int]] = field(default_factory=list)
    """Frame and stamp (ns) of each `CameraInfo`."""
    looked_at: list[tuple[str, int]] = field(default_factory=list)
    """Frame and stamp (ns) of each `Detection2DArray`, boxes or none."""
    topics_of: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    """The topics that have detections of a frame."""
    boxes: dict[tuple[str, int], list[tuple[str, float, float, float, float, float]]] = field(
        default_factory=lambda: defaultdict(list)
    )
    without_class: int = 0


@Reader
def read_ros(
    bags: Sequence[Path],
    *,
    detections: DetectionFile | Path | None = None,
    world_frame: str | None = None,
    body_frame: str | None = None,
    pose_topic: str | None = None,
    detection_topics: Sequence[str] = (),
    class_name: str = "object",
    rectified: bool = False,
    pixel_center: float = 0.5,
    longest_gap_s: float = 0.2,
    up: tuple[float, float, float] | None = None,
    anchor: tuple[float, float, float] | None = None,
    max_rejected: float = MAX_REJECTED,
    progress: Progress = silent,
    tell: Callable[[str], None] | None = None,
) -> Imported:
    """Read bags of one drive: `CameraInfo`, `TFMessage` or poses, and `Detection2DArray` messages.

    Every message of detections is an image, named `FRAME/SECONDS.NANOSECONDS.png` by its header; without detections
    every message of a `CameraInfo`. The pose of its frame is that in the tree of transforms, interpolated in time.
    Frames are optical ones (x right, y down, z forward), as the convention for `CameraInfo` is.

    Parameters
    ----------
    bags
        Bags that belong together.
    detections
        As in `read_detections`, instead of those in the bags.
    world_frame
        The fixed frame; by default the top of the tree that the cameras are in.
    body_frame
        What the poses of `pose_topic` are of; `Odometry` says it itself.
    pose_topic
        A topic of `PoseStamped`, `PoseWithCovarianceStamped` or `Odometry`: what its poses are of is where these say,
        and no transform of that frame counts.
    detection_topics
        The topics of detections that count, where not all do.
    class_name
        The class of detections in the bags that have none.
    rectified
        Boxes are on rectified pictures: the matrix P and no distortion counts.
    pixel_center
        Coordinates of the centre of the top-left pixel in the boxes of the bags; in `CameraInfo` it is 0.
    longest_gap_s
        Poses this far apart are interpolated.
    up, anchor, max_rejected
        As in `assemble`.
    tell
        Called with each line that is worth knowing about the bags.

    Raises
    ------
    InputError
        A bag is missing or damaged, or lacks what is needed; a frame has two parents, a camera detections in several
        topics, or no camera moves.
    SettingError
        There is no such topic or frame, or the package rosbags is not installed.
    """
    longest = nanoseconds_of_gap(longest_gap_s)
    if detections is not None and detection_topics:
        raise SettingError(
            "detection-topic: chooses among detections in the bags, and --detections takes others instead",
            hint="leave one of the two away",
        )
    with _open(bags) as reader:
        bag = _Bag(_frames(reader, str(bags[0]), pose_topic))
        topics = _topics_of_boxes(reader, detection_topics) if detections is None else set()
        _read_messages(reader, bag, topics, body_frame, class_name, rectified, progress)
    if not bag.cameras:
        raise InputError(f"{bags[0]}: there is no CameraInfo in it", hint="record it beside the pictures")
    notes = _notes_of_stamps(bag, bags[0])
    images_at = sorted(set(bag.looked_at or bag.exposures))
    frame_of = _camera_frames({frame for frame, _ in images_at}, bag, bags[0])
    notes += [
        f"detections are of frame {frame!r}, CameraInfo of {camera!r}: they are taken for those of this camera"
        for frame, camera in frame_of.items()
        if frame != camera
    ]
    if not detection_topics:
        _refuse_several_topics(frame_of, bag, bags[0])
    world = None if world_frame is None else _frame(world_frame)
    paths = {frame: bag.frames.path(frame_of[frame], world) for frame in sorted(frame_of)}
    bag.frames.check_topic_counts(list(paths.values()))
    names, rotations, centers, frames, times = [], [], [], [], []
    for frame, path in paths.items():
        stamps = np.array([stamp for other, stamp in images_at if other == frame], dtype=np.int64)
        rotation, center = bag.frames.poses_along(path, stamps, longest)
        rotations.append(rotation)
        centers.append(center)
        times.append(stamps)
        frames += [frame] * len(stamps)
        names += [_name(frame, stamp) for stamp in stamps.tolist()]
    _refuse_still(centers, paths, bag.frames)
    stamps = np.concatenate(times)
    table, camera_id = make_cameras([bag.cameras[frame_of[frame]] for frame in frames], str(bags[0]))
    passes = [Path(bags[0]).stem] * len(names)
    images = make_images(
        names=names,
        camera_id=camera_id,
        world_from_cam=np.concatenate(rotations),
        center_in_world_m=np.concatenate(centers),
        passes=passes,
        source=str(bags[0]),
        timestamp_s=np.asarray(stamps * _NANO, dtype=np.float64),
        rigs=rigs_by_time(frames, (stamps - stamps.min()) * _NANO, passes),
    )
    dataset = assemble(
        name=Path(bags[0]).stem,
        cameras=table,
        images=images,
        detections=_found_boxes(bag, images, pixel_center)
        if detections is None
        else read_detections(detections, images, table),
        up=up,
        anchor=anchor,
        source=str(bags[0]),
        max_rejected=max_rejected,
        unposed=images_without_poses(images, longest_gap_s),
    )
    progress("reading the bags", 1, 1)
    if bag.without_class:
        notes.append(
            f"{bag.without_class} of {sum(map(len, bag.boxes.values()))} detections have no class: they are "
            f"{class_name!r} (--class)"
        )
    if tell is not None:
        for line in (*notes, *bag.frames.notes()):
            tell(line)
    return dataset


def _name(frame: str, stamp_ns: int) -> str:
    return f"{frame}/{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}.png"


@contextmanager
def _open(bags: Sequence[Path]) -> Iterator[Any]:
    """Yield a reader of the bags; whatever it raises on damaged ones is an `InputError`."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ModuleNotFoundError as error:
        raise SettingError("bags need the package rosbags", hint="pip install 'valuemap[ros]'") from error
    for bag in bags:
        if not (bag.is_file() or (bag / "metadata.yaml").is_file()):
            raise InputError(f"{bag}: is no bag", hint=f"expected {_EXPECTED}")
    store = get_typestore(Stores.ROS2_HUMBLE)
    types: dict[str, Any] = {}
    for name, text in _VISION_MSGS.items():
        types |= get_types_from_msg(text, name)
    store.register(types)
    try:
        with AnyReader(list(bags), default_typestore=store) as reader:
            yield reader
    except (InputError, SettingError, KeyboardInterrupt):
        raise
    except Exception as error:  # Its parsers raise many types on damaged files.
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(
            f"{bags[0]}: cannot be read as a bag: {reason}", hint=f"expected {_EXPECTED}, whole"
        ) from error


def _frames(reader: Any, source: str, pose_topic: str | None) -> Frames:
    """Return no frames yet, with what topics of poses there are."""
    known = sorted({connection.topic for connection in reader.connections if connection.msgtype in _POSES})
    if pose_topic is not None and pose_topic not in known:
        raise SettingError(
            f"pose-topic {pose_topic}: no topic of poses", hint=f"there are {', '.join(known) or 'none'}: leave it away"
        )
    return Frames(source, pose_topic, tuple(topic for topic in known if topic != pose_topic))


def _topics_of_boxes(reader: Any, chosen: Sequence[str]) -> set[str]:
    """Return the topics of detections that are chosen, or all."""
    known = {connection.topic for connection in reader.connections if connection.msgtype == _DETECTIONS}
    for topic in chosen:
        if topic not in known:
            raise SettingError(
                f"detection-topic {topic}: no topic of detections",
                hint=f"one of {', '.join(sorted(known))}" if known else "there is none: leave it away",
            )
    return set(chosen) or known


def _read_messages(
    reader: Any,
    bag: _Bag,
    topics_of_boxes: set[str],
    body_frame: str | None,
    class_name: str,
    rectified: bool,
    progress: Progress,
) -> None:
    wanted = [
        connection
        for connection in reader.connections
        if connection.msgtype in (_CAMERA_INFO, *_TF)
        or connection.topic in topics_of_boxes
        or connection.topic == bag.frames.pose_topic
    ]
    total = sum(connection.msgcount for connection in wanted)
    for number, (connection, _, data) in enumerate(reader.messages(connections=wanted)):
        if number % 1000 == 0:
            progress("reading the bags", number, total)
        message = reader.deserialize(data, connection.msgtype)
        if connection.msgtype in _TF:
            for transform in message.transforms:
                _add_transform(transform, bag, is_static=connection.topic.rstrip("/").endswith("tf_static"))
        elif connection.msgtype == _CAMERA_INFO:
            _add_camera(message, bag, rectified)
        elif connection.msgtype == _DETECTIONS:
            _add_boxes(message, bag, connection.topic, class_name)
        else:
            _add_pose(message, bag, body_frame)


def _stamp_ns(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def _frame(name: str) -> str:
    return name.strip("/")


def _add_transform(transform: Any, bag: _Bag, *, is_static: bool) -> None:
    pose = _pose(transform.transform.translation, transform.transform.rotation)
    parent, child = _frame(transform.header.frame_id), _frame(transform.child_frame_id)
    bag.frames.add_transform(parent, child, _stamp_ns(transform.header), pose, is_static=is_static)


def _add_pose(message: Any, bag: _Bag, body_frame: str | None) -> None:
    pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
    child = _frame(body_frame or getattr(message, "child_frame_id", "") or "")
    if not child:
        raise SettingError(
            f"pose-topic {bag.frames.pose_topic}: does not say what its poses are of",
            hint="give --body-frame base_link",
        )
    parent = _frame(message.header.frame_id)
    bag.frames.add_pose(parent, child, _stamp_ns(message.header), _pose(pose.position, pose.orientation))


def _pose(place: Any, turn: Any) -> tuple[float, ...]:
    return place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w


def _add_camera(message: Any, bag: _Bag, rectified: bool) -> None:
    """Take the intrinsics of a frame; ROS 1 names its fields in capitals."""
    frame = _frame(message.header.frame_id)
    bag.exposures.append((frame, _stamp_ns(message.header)))
    if frame in bag.cameras:
        return
    k, d, r, p = (
        np.asarray(getattr(message, name, getattr(message, name.upper(), ())), dtype=np.float64) for name in "kdrp"
    )
    if len(k) != 9 or len(p) != 12 or not np.isfinite([*k, *d, *p]).all():
        raise InputError(
            f"CameraInfo of {frame}: expected 9 and 12 finite numbers in K and P", hint="is it calibrated?"
        )
    if rectified and not np.allclose(r.reshape(3, 3), np.eye(3), atol=1e-9):
        raise InputError(
            f"CameraInfo of {frame}: its rectification turns the camera, and tf is about the raw one",
            hint="import boxes on the raw pictures",
        )
    matrix = p.reshape(3, 4) if rectified else k.reshape(3, 3)
    # K and P are of the full resolution; pictures are a window of it, of pixels that are several ones each. 0 is none.
    window, across, down = message.roi, max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    pinhole = (
        matrix[0, 0] / across,
        matrix[1, 1] / down,
        (matrix[0, 2] + 0.5 - window.x_offset) / across,
        (matrix[1, 2] + 0.5 - window.y_offset) / down,
    )
    width, height = (window.width or message.width) // across, (window.height or message.height) // down
    model, distortion = ("PINHOLE", ()) if rectified else _distortion(message.distortion_model, d, frame)
    params = tuple(float(value) for value in (*pinhole, *distortion))
    bag.cameras[frame] = Camera(model, int(width), int(height), params)


def _distortion(model: str, d: Floats, frame: str) -> tuple[str, tuple[float, ...]]:
    """Return COLMAP's model and its parameters after the pinhole's, of OpenCV's k1, k2, p1, p2, k3 .. k6.

    Thin prisms and tilts, which OpenCV has after these, must be 0, as drivers fill them up.
    """
    if model in _FISHEYES and (len(d) == 4 or not d.any()):  # Zeros too are no pinhole: r = f theta.
        k1, k2, k3, k4 = (*d.tolist(), *[0.0] * 4)[:4]
        return "OPENCV_FISHEYE", (k1, k2, k3, k4)
    if not d.any():
        return "PINHOLE", ()
    if model in ("plumb_bob", "rational_polynomial") and len(d) in (4, 5, 8, 12, 14) and not d[8:].any():
        k1, k2, p1, p2, k3, k4, k5, k6 = (*d.tolist(), *[0.0] * 4)[:8]
        return "FULL_OPENCV", (k1, k2, p1, p2, k3, k4, k5, k6)
    raise InputError(
        f"CameraInfo of {frame}: distortion_model {model!r} with {len(d)} parameters is not known",
        hint="expected plumb_bob, rational_polynomial or equidistant; or boxes on rectified pictures (--rectified)",
    )


def _add_boxes(message: Any, bag: _Bag, topic: str, class_name: str) -> None:
    key = (_frame(message.header.frame_id), _stamp_ns(message.header))
    bag.looked_at.append(key)
    bag.topics_of[key[0]].add(topic)
    for detection in message.detections:
        center = getattr(detection.bbox.center, "position", detection.bbox.center)
        hypotheses = [getattr(result, "hypothesis", result) for result in detection.results]
        best = max(hypotheses, key=lambda hypothesis: hypothesis.score, default=None)
        own_class = "" if best is None else str(getattr(best, "class_id", getattr(best, "id", "")))
        bag.without_class += not own_class
        score = 1.0 if best is None else float(best.score)
        size = detection.bbox.size_x, detection.bbox.size_y
        bag.boxes[key].append((own_class or class_name, center.x, center.y, *size, score))


def _notes_of_stamps(bag: _Bag, source: Path) -> list[str]:
    """Return what is to be told about images whose headers say no time; refuse them where none does."""
    stamps = [stamp for _, stamp in bag.looked_at or bag.exposures]
    what = _DETECTIONS if bag.looked_at else _CAMERA_INFO
    unknown = stamps.count(0)
    said = f"{len(stamps)} messages of {what.rpartition('/')[2]} have the stamp 0 in their headers"
    if unknown == len(stamps) > 1:
        raise InputError(
            f"{source}: all {said}",
            hint="the stamps say when a picture was taken: set them where the messages are published",
        )
    return [f"{unknown} of {said}: they count as one image of each camera"] if unknown > 1 else []


def _camera_frames(frames: set[str], bag: _Bag, source: Path) -> dict[str, str]:
    """Return the frame of the camera for each frame that images have.

    A bag of one camera whose detections have one frame, whatever it is called, has the detections of that camera.
    """
    known = sorted(bag.cameras)
    if len(frames) == 1 and len(known) == 1:
        return dict.fromkeys(frames, known[0])
    for frame in sorted(frames - bag.cameras.keys()):
        raise InputError(
            f"{source}: detections of frame {frame!r}, but CameraInfo of {', '.join(known)}",
            hint="detections must have the frame of their camera in the header",
        )
    return {frame: frame for frame in frames}


def _refuse_several_topics(frame_of: dict[str, str], bag: _Bag, source: Path) -> None:
    """Refuse several topics with detections of one camera, which may be those of one detector, raw and filtered."""
    for frame, topics in sorted(bag.topics_of.items()):
        if len(topics) > 1:
            raise InputError(
                f"{source}: detections of the camera {frame_of[frame]!r} are in several topics: "
                f"{', '.join(sorted(topics))}",
                hint="choose with --detection-topic, which may be repeated",
            )


def _refuse_still(centers: Sequence[Floats], paths: dict[str, list[str]], frames: Frames) -> None:
    """Refuse cameras that all stay where they are, by their places (N, 3) each: their poses are elsewhere."""
    places = [center[np.isfinite(center).all(axis=1)] for center in centers]
    if max(map(len, places)) < 2 or any(len(place) and np.ptp(place, axis=0).max() > STILL_M for place in places):
        return
    where = "; ".join(sorted({" in ".join(path) for path in paths.values()}))
    read = "tf" if frames.pose_topic is None else f"tf and {frames.pose_topic}"
    raise InputError(
        f"{frames.source}: no camera ever moves in {read}: {where}",
        hint=f"record /tf while the car moves{frames.or_topic()}",
    )


def _found_boxes(bag: _Bag, images: Images, pixel_center: float) -> FoundBoxes:
    rows = [(_name(*key), number, box) for key, boxes in sorted(bag.boxes.items()) for number, box in enumerate(boxes)]
    if not rows:
        return FoundBoxes.none()
    row_of = {name: row for row, name in enumerate(images.name.to_pylist())}
    values = np.array([box[1:] for _, _, box in rows], dtype=np.float64)
    return FoundBoxes(
        image_row=np.array([row_of[name] for name, _, _ in rows], dtype=np.int64),
        class_names=[box[0] for _, _, box in rows],
        center_px=values[:, :2] + shift_to_corner_px(pixel_center, "box-pixel-center"),
        size_px=values[:, 2:4],
        score=values[:, 4],
        where=lambda row: f"{rows[row][0]}: detections[{rows[row][1]}]",
    )
