"""ROS bags, written here message by message: a car with a camera in front, whose poses are in tf or in odometry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from reading import meeting_point, refusal, write
from valuemap.cameras import camera_centers
from valuemap.cli.import_.app import import_app
from valuemap.dataset import read_dataset
from valuemap.readers.ros import read_ros

pytest.importorskip("rosbags", reason="the package rosbags is not installed: pip install 'valuemap[ros]'")

from rosbags.rosbag1 import Writer as OldWriter
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

OBJECT = np.array([30.0, 4.0, 3.0])
STAMPS_NS = [10**18 + i * 500_000_000 for i in range(4)]
# The car drives along x and turns; the optical frame looks along the car's x.
CAR_FROM_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
CAMERA_IN_CAR = np.array([1.5, 0.2, 1.4])
CARS = [(np.array([3.0 * i, 0.3 * i, 0.0]), Rotation.from_euler("z", 0.04 * i)) for i in range(4)]
FX, FY, CX, CY = 500.0, 505.0, 319.5, 239.5


def typestore() -> Any:
    """The messages of vision_msgs as its package defines them, comments left away."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    definitions = {
        "Point2D": "float64 x\nfloat64 y",
        "Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
        "BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
        "ObjectHypothesis": "string class_id\nfloat64 score",
        "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
        "Detection2D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox2D bbox\nstring id",
        "Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections",
    }
    for name, text in definitions.items():
        store.register(get_types_from_msg(text + "\n", f"vision_msgs/msg/{name}"))
    return store


class Bag:
    """Writes messages of one bag."""

    def __init__(self, path: Path) -> None:
        self.store = typestore()
        self.writer = Writer(path, version=9)
        self.writer.open()
        self.connections: dict[str, Any] = {}

    def make(self, name: str, *values: Any) -> Any:
        return self.store.types[name](*values)

    def header(self, frame: str, stamp_ns: int) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", stamp_ns // 10**9, stamp_ns % 10**9)
        return self.make("std_msgs/msg/Header", stamp, frame)

    def pose_parts(self, place: Any, turn: Rotation, vector: str) -> tuple[Any, Any]:
        x, y, z, w = map(float, turn.as_quat())
        return self.make(f"geometry_msgs/msg/{vector}", *map(float, place)), self.make(
            "geometry_msgs/msg/Quaternion", x, y, z, w
        )

    def transform(self, parent: str, child: str, stamp_ns: int, place: Any, turn: Rotation) -> Any:
        parts = self.pose_parts(place, turn, "Vector3")
        transform = self.make("geometry_msgs/msg/Transform", *parts)
        stamped = self.make("geometry_msgs/msg/TransformStamped", self.header(parent, stamp_ns), child, transform)
        return self.make("tf2_msgs/msg/TFMessage", [stamped])

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        self.writer.write(self.connections[topic], stamp_ns, self.store.serialize_cdr(message, kind))


def camera_info(
    bag: Bag,
    stamp_ns: int,
    model: str = "plumb_bob",
    d: tuple[float, ...] = (0.0,) * 5,
    window: tuple[int, int, int, int] = (0, 0, 0, 0),
    binning: int = 0,
    frame: str = "cam_optical",
) -> Any:
    k = np.array([FX, 0, CX, 0, FY, CY, 0, 0, 1], np.float64)
    p = np.array([400.0, 0, 300, 0, 0, 400, 200, 0, 0, 0, 1, 0])
    left, top, width, height = window
    roi = bag.make("sensor_msgs/msg/RegionOfInterest", left, top, height, width, False)
    parts = (np.array(d, np.float64), k, np.eye(3).ravel(), p, binning, binning, roi)
    return bag.make("sensor_msgs/msg/CameraInfo", bag.header(frame, stamp_ns), 480, 640, model, *parts)


LIGHT = (("sign", 0.2), ("light", 0.7))


def detections(
    bag: Bag,
    stamp_ns: int,
    center_px: Any,
    classes: tuple[tuple[str, float], ...] = LIGHT,
    frame: str = "cam_optical",
) -> Any:
    x, y = map(float, center_px)
    point = bag.make("vision_msgs/msg/Point2D", x, y)
    box = bag.make("vision_msgs/msg/BoundingBox2D", bag.make("vision_msgs/msg/Pose2D", point, 0.0), 12.0, 20.0)
    pose = bag.make(
        "geometry_msgs/msg/PoseWithCovariance",
        bag.make("geometry_msgs/msg/Pose", *bag.pose_parts((0, 0, 0), Rotation.identity(), "Point")),
        np.zeros(36),
    )
    results = [
        bag.make("vision_msgs/msg/ObjectHypothesisWithPose", bag.make("vision_msgs/msg/ObjectHypothesis", *each), pose)
        for each in classes
    ]
    header = bag.header(frame, stamp_ns)
    found = bag.make("vision_msgs/msg/Detection2D", header, results, box, "")
    return bag.make("vision_msgs/msg/Detection2DArray", header, [found])


def write_bag(
    path: Path,
    *,
    poses: str = "tf",
    model: str = "plumb_bob",
    d: tuple[float, ...] = (0.0,) * 5,
    window: tuple[int, int, int, int] = (0, 0, 0, 0),
    binning: int = 0,
    frame: str = "cam_optical",
    is_stamped: bool = True,
    classes: tuple[tuple[str, float], ...] = LIGHT,
    also: Callable[[Bag, int], None] | None = None,
) -> Path:
    """Images between the poses, which are every half second: on a straight way at constant turn these are exact.

    Detections are of a frame, and of time 0 where they are not stamped; `also` writes more after each pose.
    """
    bag = Bag(path)
    optical = Rotation.from_matrix(CAR_FROM_CAM)
    bag.write("/tf_static", bag.transform("base_link", "cam_optical", 0, CAMERA_IN_CAR, optical), STAMPS_NS[0])
    for stamp, (place, turn) in zip(STAMPS_NS, CARS, strict=True):
        if poses == "tf":
            bag.write("/tf", bag.transform("map", "base_link", stamp, place, turn), stamp)
        else:
            zero = bag.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
            twist = bag.make(
                "geometry_msgs/msg/TwistWithCovariance", bag.make("geometry_msgs/msg/Twist", zero, zero), np.zeros(36)
            )
            pose = bag.make("geometry_msgs/msg/Pose", *bag.pose_parts(place, turn, "Point"))
            posed = bag.make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36))
            odometry = bag.make("nav_msgs/msg/Odometry", bag.header("odom", stamp), "base_link", posed, twist)
            bag.write("/odometry", odometry, stamp)
        if also is not None:
            also(bag, stamp)
    for number in (0, 1, 2):
        stamp = STAMPS_NS[number] + 100_000_000  # A fifth of the way to the next pose.
        place = 0.8 * CARS[number][0] + 0.2 * CARS[number + 1][0]
        turn = Rotation.from_euler("z", 0.04 * (number + 0.2))
        in_car = turn.inv().apply(OBJECT - place)
        x, y, z = CAR_FROM_CAM.T @ (in_car - CAMERA_IN_CAR)
        bag.write("/camera_info", camera_info(bag, stamp, model, d, window, binning), stamp)
        # Pixels of CameraInfo count from the middle of the top-left one, boxes from the picture's corner.
        center_px = np.array([FX * x / z + CX + 0.5, FY * y / z + CY + 0.5])
        center_px = (center_px - window[:2]) / max(binning, 1)
        found = detections(bag, stamp if is_stamped else 0, center_px, classes, frame)
        bag.write("/detections", found, stamp)
    bag.writer.close()
    return path


@pytest.mark.parametrize("poses", ["tf", "odometry"])
def test_boxes_of_a_bag_meet_where_the_object_is(tmp_path: Path, poses: str) -> None:
    options = {"pose_topic": "/odometry"} if poses == "odometry" else {}
    dataset = read_ros([write_bag(tmp_path / "bag", poses=poses)], longest_gap_s=1.0, **options)  # type: ignore[arg-type]
    assert_allclose(meeting_point(dataset), OBJECT, atol=1e-6)
    assert dataset.detections.class_name.texts() == ["light"] * 3
    assert_allclose(dataset.detections.score, 0.7)
    assert_allclose(dataset.detections.size_px, [[12.0, 20.0]] * 3)
    assert dataset.images.name.to_pylist()[0] == "cam_optical/1000000000.100000000.png"
    assert dataset.images.timestamp_s is not None
    assert_allclose(dataset.images.timestamp_s - 1e9, [0.1, 0.6, 1.1], atol=1e-6)
    first = 0.2 * CARS[1][0] + Rotation.from_euler("z", 0.008).apply(CAMERA_IN_CAR)
    assert_allclose(camera_centers(dataset.images)[0], first, atol=1e-9)


@pytest.mark.parametrize(
    ("window", "binning", "size"),
    [((0, 0, 0, 0), 2, (320, 240)), ((100, 40, 500, 400), 1, (500, 400)), ((100, 40, 500, 400), 2, (250, 200))],
)
def test_pictures_may_be_a_part_of_what_a_camera_sees_and_smaller(
    tmp_path: Path, window: tuple[int, int, int, int], binning: int, size: tuple[int, int]
) -> None:
    """K and P are of the full resolution; boxes are in the pictures that the camera gave."""
    dataset = read_ros([write_bag(tmp_path / "bag", window=window, binning=binning)], longest_gap_s=1.0)
    assert_allclose(meeting_point(dataset), OBJECT, atol=1e-6)
    assert (dataset.cameras.width_px[0], dataset.cameras.height_px[0]) == size


def test_images_in_gaps_of_the_poses_have_none(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag")
    assert "in a gap of them that is longer than 0.3 s" in refusal(lambda: read_ros([path], longest_gap_s=0.3))
    assert "longest-gap: expected seconds from 0" in refusal(lambda: read_ros([path], longest_gap_s=np.nan))


def test_the_distortion_of_a_bag_is_opencvs(tmp_path: Path) -> None:
    plumb = write_bag(tmp_path / "plumb", d=(-0.2, 0.05, 0.001, -0.002, 0.003))
    camera = read_ros([plumb], longest_gap_s=1.0).cameras
    assert camera.model.texts() == ["FULL_OPENCV"]
    assert camera.params[0].tolist() == [FX, FY, CX + 0.5, CY + 0.5, -0.2, 0.05, 0.001, -0.002, 0.003, 0, 0, 0]
    rational = (-0.2, 0.05, 0.001, -0.002, 0.003, 0.4, 0.5, 0.6)
    filled = write_bag(tmp_path / "filled", model="rational_polynomial", d=(*rational, *[0.0] * 6))  # As DepthAI does.
    assert read_ros([filled], longest_gap_s=1.0).cameras.params[0].tolist()[4:] == list(rational)
    prism = write_bag(tmp_path / "prism", model="rational_polynomial", d=(*rational, 0.1, *[0.0] * 5))
    assert "distortion_model 'rational_polynomial' with 14 parameters" in refusal(lambda: read_ros([prism]))
    for number, d in enumerate([(0.1, 0.2, 0.3, 0.4), (0.0,) * 4, ()]):
        fisheye = write_bag(tmp_path / f"fisheye{number}", model="equidistant", d=d)
        camera = read_ros([fisheye], longest_gap_s=1.0).cameras
        assert camera.model.texts() == ["OPENCV_FISHEYE"]  # Also of zeros: the angle to the axis is as the radius.
        assert camera.params[0].tolist()[4:8] == list((*d, *(0.0,) * 4)[:4])
    rectified = read_ros([plumb], longest_gap_s=1.0, rectified=True).cameras
    assert rectified.params[0].tolist() == [400, 400, 300.5, 200.5]
    other = write_bag(tmp_path / "other", model="kannala", d=(0.1, 0.2))
    assert "distortion_model 'kannala' with 2 parameters is not known" in refusal(lambda: read_ros([other]))


def test_frames_and_topics_that_are_not_there(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag")
    assert "is not below it" in refusal(lambda: read_ros([path], world_frame="moon"))
    assert "no topic of poses" in refusal(lambda: read_ros([path], pose_topic="/odometry"))
    bag = Bag(tmp_path / "empty")
    bag.write("/tf", bag.transform("map", "base_link", 5, (0, 0, 0), Rotation.identity()), 5)
    bag.writer.close()
    assert "there is no CameraInfo in it" in refusal(lambda: read_ros([tmp_path / "empty"]))
    bag = Bag(tmp_path / "circle")
    for parent, child in (("a", "cam_optical"), ("cam_optical", "a")):
        bag.write("/tf_static", bag.transform(parent, child, 5, (0, 0, 0), Rotation.identity()), 5)
    bag.write("/camera_info", camera_info(bag, 5), 5)
    bag.writer.close()
    assert "go in a circle" in refusal(lambda: read_ros([tmp_path / "circle"]))


def wrong_transform(parent: str, *, to: str = "base_link") -> Callable[[Bag, int], None]:
    """What writes a transform of the car to where it is not, between its pose and the image."""

    def write_it(bag: Bag, stamp: int) -> None:
        for time in (stamp - 50_000_000, stamp + 50_000_000):
            bag.write("/tf", bag.transform(parent, to, time, (100, 50, 0), Rotation.identity()), time)

    return write_it


def test_poses_of_a_topic_replace_the_transforms_of_their_frame(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", poses="odometry", also=wrong_transform("map"))
    dataset = read_ros([path], pose_topic="/odometry", longest_gap_s=1.0)
    assert_allclose(meeting_point(dataset), OBJECT, atol=1e-6)
    said = refusal(lambda: read_ros([path], pose_topic="/odometry", body_frame="wheel", longest_gap_s=1.0))
    assert "its poses are of 'wheel', and no camera is below that" in said
    assert "one of base_link, cam_optical, map" in said


def test_a_frame_with_two_parents_is_where_the_chosen_one_says(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", also=wrong_transform("odom"))
    said = refusal(lambda: read_ros([path], longest_gap_s=1.0))
    assert "the frame 'base_link' has several parents in tf: 'map', 'odom'" in said
    assert "choose with --world-frame map or odom (there is no topic of poses)" in said
    assert_allclose(meeting_point(read_ros([path], world_frame="map", longest_gap_s=1.0)), OBJECT, atol=1e-6)

    def both(bag: Bag, stamp: int) -> None:
        wrong_transform("odom")(bag, stamp)
        wrong_transform("map", to="odom")(bag, stamp)

    path = write_bag(tmp_path / "both", also=both)
    # The one parent is below the other, so that map does not say which.
    for said in (refusal(lambda: read_ros([path])), refusal(lambda: read_ros([path], world_frame="map"))):
        assert "several parents in tf: 'map', 'odom' | choose with --world-frame odom" in said


def test_transforms_may_be_said_again_and_again(tmp_path: Path) -> None:
    optical = Rotation.from_matrix(CAR_FROM_CAM)

    def again(bag: Bag, stamp: int) -> None:
        bag.write("/tf_static", bag.transform("base_link", "cam_optical", stamp, CAMERA_IN_CAR, optical), stamp)

    path = write_bag(tmp_path / "bag", also=again)
    assert_allclose(meeting_point(read_ros([path], longest_gap_s=1.0)), OBJECT, atol=1e-6)


def without_rotation(bag: Bag, message: Any) -> Any:
    """The same transform with a quaternion of zeros."""
    (stamped,) = message.transforms
    zero = bag.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 0.0)
    return replace(message, transforms=[replace(stamped, transform=replace(stamped.transform, rotation=zero))])


def test_transforms_without_a_rotation_are_left_out(tmp_path: Path) -> None:
    def broken(bag: Bag, stamp: int) -> None:
        time = stamp + 100_000_000  # That of the image.
        bag.write("/tf", without_rotation(bag, bag.transform("map", "base_link", time, (0, 0, 0), CARS[0][1])), time)

    notes: list[str] = []
    dataset = read_ros([write_bag(tmp_path / "bag", also=broken)], longest_gap_s=1.0, tell=notes.append)
    assert_allclose(meeting_point(dataset), OBJECT, atol=1e-6)
    unusable = "a number is not finite, or the quaternion is not of length 1"
    assert notes == [f"left out: 4 of 8 poses of 'base_link' in 'map': {unusable}"]
    path = write_bag(tmp_path / "none", poses="odometry", also=broken)
    said = refusal(lambda: read_ros([path]))
    assert f"none of 4 poses of 'base_link' in 'map' can be used: {unusable}" in said
    assert "give --pose-topic, one of /odometry" in said


def test_cameras_that_never_move_have_their_poses_elsewhere(tmp_path: Path) -> None:
    said = refusal(lambda: read_ros([write_bag(tmp_path / "bag", poses="odometry")]))
    assert "no camera ever moves in tf: cam_optical in base_link |" in said
    assert "record /tf while the car moves, or give --pose-topic, one of /odometry" in said


def test_messages_without_a_time_are_counted(tmp_path: Path) -> None:
    said = refusal(lambda: read_ros([write_bag(tmp_path / "none", is_stamped=False)]))
    assert "all 3 messages of Detection2DArray have the stamp 0 in their headers" in said

    def unstamped(bag: Bag, stamp: int) -> None:
        if stamp != STAMPS_NS[0]:
            bag.write("/detections", detections(bag, 0, (9, 9)), stamp)

    notes: list[str] = []
    path = write_bag(tmp_path / "some", also=unstamped)
    dataset = read_ros([path], longest_gap_s=1.0, max_rejected=1.0, tell=notes.append)
    assert_allclose(meeting_point(dataset), OBJECT, atol=1e-6)
    assert notes == [
        "3 of 6 messages of Detection2DArray have the stamp 0 in their headers: they count as one image of each camera"
    ]
    bag = Bag(tmp_path / "tf")
    for place in range(3):
        bag.write("/tf", bag.transform("map", "cam_optical", 0, (place, 0, 0), Rotation.identity()), place)
        bag.write("/camera_info", camera_info(bag, STAMPS_NS[place]), place)
    bag.writer.close()
    said = refusal(lambda: read_ros([tmp_path / "tf"]))
    assert "all 3 poses of 'cam_optical' in 'map' have the stamp 0 in their headers" in said


def more_detections(bag: Bag, stamp: int) -> None:
    """Another detector's, at the time of the image after a pose."""
    if stamp != STAMPS_NS[-1]:
        bag.write("/raw", detections(bag, stamp + 100_000_000, (9, 9), (("car", 0.5),)), stamp)


def test_a_camera_has_the_detections_of_one_topic_or_of_those_chosen(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", also=more_detections)
    said = refusal(lambda: read_ros([path], longest_gap_s=1.0))
    assert "detections of the camera 'cam_optical' are in several topics: /detections, /raw" in said
    assert "choose with --detection-topic" in said
    dataset = read_ros([path], detection_topics=["/detections"], longest_gap_s=1.0)
    assert dataset.detections.class_name.texts() == ["light"] * 3
    dataset = read_ros([path], detection_topics=["/raw", "/detections"], longest_gap_s=1.0)
    assert sorted(dataset.detections.class_name.texts()) == ["car"] * 3 + ["light"] * 3
    said = refusal(lambda: read_ros([path], detection_topics=["/seen"]))
    assert "detection-topic /seen: no topic of detections | one of /detections, /raw" in said
    boxes = write(tmp_path / "boxes.csv", "image,x,y\n")
    said = refusal(lambda: read_ros([path], detections=boxes, detection_topics=["/raw"]))
    assert "leave one of the two away" in said


def test_cameras_may_have_topics_of_their_own(tmp_path: Path) -> None:
    def rear(bag: Bag, stamp: int) -> None:
        to_side = bag.transform("base_link", "rear", stamp, (0, 0, 0), Rotation.from_matrix(CAR_FROM_CAM))
        bag.write("/tf_static", to_side, stamp)
        bag.write("/rear/camera_info", camera_info(bag, stamp, frame="rear"), stamp)
        bag.write("/rear/detections", detections(bag, stamp, (9, 9), frame="rear"), stamp)

    dataset = read_ros([write_bag(tmp_path / "bag", also=rear)], longest_gap_s=1.0)
    assert sorted(name.split("/")[0] for name in dataset.images.name.to_pylist()) == ["cam_optical"] * 3 + ["rear"] * 4
    said = refusal(lambda: read_ros([write_bag(tmp_path / "other", also=rear, frame="roof")], longest_gap_s=1.0))
    assert "detections of frame 'roof', but CameraInfo of cam_optical, rear" in said


def test_detections_of_any_one_frame_are_those_of_the_one_camera(tmp_path: Path) -> None:
    notes: list[str] = []
    dataset = read_ros([write_bag(tmp_path / "bag", frame="roof")], longest_gap_s=1.0, tell=notes.append)
    assert_allclose(meeting_point(dataset), OBJECT, atol=1e-6)
    told = "detections are of frame 'roof', CameraInfo of 'cam_optical': they are taken for those of this camera"
    assert notes == [told]
    path = write_bag(tmp_path / "both", frame="roof", also=more_detections)  # Which are of the camera's own frame.
    said = refusal(lambda: read_ros([path], longest_gap_s=1.0))
    assert "detections of frame 'roof', but CameraInfo of cam_optical" in said


def test_detections_without_a_class_get_one(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", classes=())
    dataset = read_ros([path], class_name="light", longest_gap_s=1.0)
    assert dataset.detections.class_name.texts() == ["light"] * 3
    assert_allclose(dataset.detections.score, 1.0)
    arguments = ["ros", str(path), "--longest-gap", "1", "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(import_app, [*arguments, "--class", "lamp", "--detection-topic", "/detections"])
    assert done.exit_code == 0, done.output
    assert "note: 3 of 3 detections have no class: they are 'lamp' (--class)" in done.stderr
    boxes = write(tmp_path / "boxes.csv", "image,x,y\ncam_optical/1000000000.100000000.png,9,9\n")
    dataset = read_ros([path], detections=boxes, longest_gap_s=1.0)
    assert dataset.detections.class_name.texts() == ["object"]
    done = CliRunner().invoke(import_app, [*arguments, "--force", "--class", "lamp", "--detections", str(boxes)])
    assert done.exit_code == 0, done.output
    assert read_dataset(tmp_path / "out").detections.class_name.texts() == ["lamp"]


def test_transforms_of_ros_1_may_have_their_first_name(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf/msg/tfMessage"))

    def header(frame: str, stamp_ns: int) -> Any:
        stamp = store.types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
        return store.types["std_msgs/msg/Header"](0, stamp, frame)

    with OldWriter(tmp_path / "drive.bag") as writer:
        messages = [("/tf", "tf/msg/tfMessage"), ("/camera_info", "sensor_msgs/msg/CameraInfo")]
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in messages}
        for stamp, (place, turn) in zip(STAMPS_NS, CARS, strict=True):
            vector = store.types["geometry_msgs/msg/Vector3"](*place)
            quaternion = store.types["geometry_msgs/msg/Quaternion"](*turn.as_quat())
            transform = store.types["geometry_msgs/msg/Transform"](vector, quaternion)
            stamped = store.types["geometry_msgs/msg/TransformStamped"](header("/map", stamp), "/cam", transform)
            tree = store.types["tf/msg/tfMessage"]([stamped])
            writer.write(connections["/tf"], stamp, store.serialize_ros1(tree, "tf/msg/tfMessage"))
            k, p = np.array([FX, 0, CX, 0, FY, CY, 0, 0, 1]), np.zeros(12)
            window = store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            info = store.types["sensor_msgs/msg/CameraInfo"](
                header("/cam", stamp), 480, 640, "plumb_bob", np.zeros(5), k, np.eye(3).ravel(), p, 0, 0, window
            )
            raw = store.serialize_ros1(info, "sensor_msgs/msg/CameraInfo")
            writer.write(connections["/camera_info"], stamp, raw)
    dataset = read_ros([tmp_path / "drive.bag"], up=(0, 0, 1))
    assert_allclose(camera_centers(dataset.images), [place for place, _ in CARS], atol=1e-9)


def test_files_that_are_no_bags(tmp_path: Path) -> None:
    assert "is no bag" in refusal(lambda: read_ros([tmp_path / "absent.bag"]))
    assert "cannot be read as a bag" in refusal(lambda: read_ros([write(tmp_path / "x.bag", "hello")]))
    assert "cannot be read as a bag" in refusal(lambda: read_ros([write(tmp_path / "y.mcap", "hello")]))
    path = write_bag(tmp_path / "bag")
    database = next(path.glob("*.db3"))
    whole = database.read_bytes()
    database.write_bytes(whole[: len(whole) // 2])
    assert "cannot be read as a bag" in refusal(lambda: read_ros([path]))
    database.write_bytes(b"")
    assert "cannot be read as a bag" in refusal(lambda: read_ros([path]))
    (path / "metadata.yaml").write_text("{")
    assert "cannot be read as a bag" in refusal(lambda: read_ros([path]))
