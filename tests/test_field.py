"""The benchmarks on real data: what they count, and that what they read points where the data says, on tiny cases."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import av2_static
import bend_ramps
import field
import kitti_signs
import kitti_ts
import london_tl
from field_data import level_rotations
from valuemap.arrays import Floats
from valuemap.cameras import camera_centers, cast_rays
from valuemap.config import MapConfig
from valuemap.dataset import Dataset, rows_of
from valuemap.errors import InputError

FIELD_DATA = Path(__file__).parents[2] / "shared" / "data"


def rays_of(dataset: Dataset) -> tuple[Floats, Floats]:
    """Return the centres and directions (N, 3) of the rays of all detections."""
    rays = cast_rays(dataset)
    return camera_centers(dataset.images)[rays.image_row], rays.direction_in_world


# What the readers make of the data.


def test_a_level_camera_looks_along_its_azimuth_with_the_sky_above() -> None:
    rotation = level_rotations(np.radians([0.0, 90.0]))
    np.testing.assert_allclose(rotation.apply([0.0, 0.0, 1.0]), [[0, 1, 0], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(rotation.apply([1.0, 0.0, 0.0]), [[1, 0, 0], [0, -1, 0]], atol=1e-12)
    np.testing.assert_allclose(rotation.apply([0.0, -1.0, 0.0]), [[0, 0, 1], [0, 0, 1]], atol=1e-12)


def test_bearings_of_panoramas_become_level_rays(tmp_path: Path) -> None:
    seen = "lat,lon,bearing,depth\n0.0,0.0,90.0,7.0\n0.0,0.0,10.0,5.0\n0.001,0.0,359.0,9.0\n0.0,0.0,225.0,6.0\n"
    (tmp_path / "detection_input.csv").write_text(seen)
    (tmp_path / "ground_truth.csv").write_text("lon,lat\n0.0,0.001\n")
    dataset = london_tl.load(tmp_path, with_range=True)
    center, direction = rays_of(dataset)
    assert dataset.images.name.to_pylist() == ["panorama-000.jpg", "panorama-001.jpg"]
    assert dataset.detections.range_m is not None
    of_range = {range_m: row for row, range_m in enumerate(dataset.detections.range_m.tolist())}
    for range_m, bearing, north_m in ((7.0, 90.0, 0.0), (5.0, 10.0, 0.0), (9.0, 359.0, 110.57), (6.0, 225.0, 0.0)):
        row, angle = of_range[range_m], np.radians(bearing)
        np.testing.assert_allclose(direction[row], [np.sin(angle), np.cos(angle), 0.0], atol=1e-9)
        np.testing.assert_allclose(center[row], [0.0, north_m, 0.0], atol=0.01)
    np.testing.assert_allclose(london_tl.truth(tmp_path), [[0.0, 110.57]], atol=0.01)


def test_the_middle_column_of_a_panorama_is_its_heading(tmp_path: Path) -> None:
    (tmp_path / "panoramas.csv").write_text("panorama_id,lat,lon,heading_deg,captured\nb,0,0,90,2024-08\n")
    seen = "panorama_id,x_normalized,y_normalized,confidence\nb,0.5,0.75,1.1\nb,0.75,0.5,0.9\n"
    (tmp_path / "detections.csv").write_text(seen)
    dataset = bend_ramps.load(tmp_path)
    center, direction = rays_of(dataset)
    assert dataset.detections.score.tolist() == [0.9, 1.1]
    np.testing.assert_allclose(center, [[0.0, 0.0, 2.5]] * 2, atol=1e-9)
    down = np.sqrt(0.5)
    np.testing.assert_allclose(direction, [[0.0, -1.0, 0.0], [down, 0.0, -down]], atol=1e-9)


def test_yaw_counts_from_east_and_pixels_from_the_centre_of_the_first(tmp_path: Path) -> None:
    head = "image,drive,lat,lon,yaw_rad_ccw_from_east,fx,cx,cy,width,height\n"
    (tmp_path / "images.csv").write_text(
        head + "d_0,d,0,0,0.0,350,600,170,1242,375\n" + f"d_1,d,0,0,{np.pi / 2},350,600,170,1242,375\n"
    )
    boxes = "image,class,x1,y1,x2,y2\nd_0,3,590,160,610,180\nd_1,4,940,160,960,180\n"
    (tmp_path / "detections.csv").write_text(boxes)
    dataset = kitti_ts.load(tmp_path)
    center, direction = rays_of(dataset)
    np.testing.assert_allclose(center, [[0.0, 0.0, 1.65]] * 2, atol=1e-9)
    np.testing.assert_allclose(direction, [[1, 0, 0], [np.sqrt(0.5), np.sqrt(0.5), 0]], atol=1e-9)
    assert dataset.cameras.params[0].tolist() == [350.0, 350.0, 600.5, 170.5]
    assert dataset.detections.center_px[0].tolist() == [600.5, 170.5]


def write_log(folder: Path) -> None:
    """Two sweeps of one camera that drives north and looks north, and three boxes of a post, one of another."""
    (folder / "log").mkdir()
    (folder / "intrinsics.csv").write_text(
        "sensor_name,fx_px,fy_px,cx_px,cy_px,k1,k2,k3,height_px,width_px\nfront,1000,1000,500,400,0,0,0,800,1000\n"
    )
    matrix = level_rotations(np.zeros(1)).as_matrix()[0]
    poses = ["k,timestamp_ns,camera," + ",".join(f"r{i}1,r{i}2,r{i}3,t{'xyz'[i - 1]}" for i in (1, 2, 3))]
    boxes = ["k,camera,category,x1,y1,x2,y2,num_interior_pts,track_uuid"]
    for k in range(3):
        center = (100.0, 200.0 + 4.0 * k, 5.0)
        rows = [f"{matrix[i, 0]},{matrix[i, 1]},{matrix[i, 2]},{center[i]}" for i in range(3)]
        poses.append(f"{k},{int(1e9) + k},front," + ",".join(rows))
        column = 500.0 + 1000.0 * 4.0 / (20.0 - 4.0 * k)
        boxes.append(f"{k},front,BOLLARD,{column - 5},390,{column + 5},410,3,near")
    boxes.append("0,front,BOLLARD,10,390,20,410,3,once")
    (folder / "log" / "camera_poses.csv").write_text("\n".join(poses))
    (folder / "log" / "projected_boxes.csv").write_text("\n".join(boxes))
    (folder / "log" / "gt_city.csv").write_text(
        "track_uuid,category,city_x,city_y,city_z,n,max_std\nnear,BOLLARD,104,220,5,3,0\nonce,BOLLARD,90,220,5,1,0\n"
    )


def test_a_log_of_cuboids_points_at_its_objects(tmp_path: Path) -> None:
    write_log(tmp_path)
    assert av2_static.logs(tmp_path) == ["log"]
    dataset = av2_static.load(tmp_path, "log")
    center, direction = rays_of(dataset)
    image_row = rows_of(dataset.detections.image_id, dataset.images.image_id)
    of_post = dataset.detections.center_px[:, 0] > 500.0
    to_post = np.array([104.0, 220.0, 5.0]) - center[of_post]
    expected = to_post / np.linalg.norm(to_post, axis=1, keepdims=True)
    np.testing.assert_allclose(direction[of_post], expected, atol=1e-9)
    assert dataset.images.timestamp_s is not None
    assert np.all(np.diff(dataset.images.timestamp_s[image_row[of_post]]) >= 0.0)
    assert av2_static.evaluable(tmp_path, "log").tolist() == [True, False]
    with pytest.raises(InputError, match="no log"):
        av2_static.logs(tmp_path / "log")


@pytest.mark.parametrize(
    ("centers", "expected"),
    [
        ([[0, 0, 0], [0, 2, 0], [0, 4, 0]], True),
        ([[0, 0, 0], [0, 2, 0]], False),  # Two boxes.
        ([[0, 0, 0], [0, 0.2, 0], [0, 0.4, 0]], False),  # 1.1 degrees.
        ([[-70, 0, 0], [-70, 4, 0], [-70, 8, 0]], False),  # 90 m away.
    ],
)
def test_objects_count_with_three_boxes_parallax_and_a_near_view(centers: list[list[float]], expected: bool) -> None:
    assert av2_static.is_evaluable(np.array(centers, float), np.array([20.0, 0.0, 0.0])) == expected


# What is counted.


def test_labels_of_static_objects_are_right_within_a_metre_and_of_the_class() -> None:
    objects = np.array([[0.0, 0, 0], [10, 0, 0], [20, 0, 0]])
    object_class = np.array(["CONE", "SIGN", "SIGN"])
    labels = np.array([[0.5, 0, 0], [0, 0.3, 0], [10.5, 0, 0], [21.5, 0, 0], [20, 0.4, 0]])
    label_class = np.array(["CONE", "CONE", "CONE", "SIGN", "SIGN"])
    counts = np.array([True, True, False])
    figures = av2_static.score_labels(labels, label_class, objects, object_class, counts)
    assert figures == {
        "objects": 2,
        "found": 1,
        "recall": 0.5,
        "labels": 5,
        "right_labels": 3,
        "false_labels": 2,
        "duplicate_labels": 1,
        "precision": 0.6,
        "precision_one_to_one": 0.4,
        "median_distance_m": 0.35,
    }


def test_lights_are_matched_one_to_one_in_the_plane() -> None:
    lights = np.array([[0.0, 0.0], [4.0, 0.0], [100.0, 0.0]])
    labels = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [105.0, 0.0]])
    figures = london_tl.score_labels(labels, lights)
    assert [figures[name] for name in ("true_6m", "false_6m", "missed_6m", "f1_6m")] == [3, 1, 0, round(6 / 7, 4)]
    assert [figures[name] for name in ("true_3m", "false_3m", "missed_3m", "f1_3m")] == [2, 2, 1, round(4 / 7, 4)]


def test_signs_are_found_by_labels_of_their_class() -> None:
    signs, sign_class = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [30.0, 0.0]]), np.array(["1", "2", "1", "1"])
    labels = np.array([[0.5, 0.0], [0.0, 0.8], [10.0, 0.1], [21.5, 0.0]])
    figures = kitti_ts.score_labels(labels, np.array(["1", "1", "1", "1"]), signs, sign_class)
    assert [figures[f"recall_{r}m"] for r in (1, 2)] == [0.25, 0.5]
    assert [figures[n] for n in ("right_labels_2m", "duplicate_labels_2m", "precision_2m")] == [3, 1, 0.75]


def test_signs_face_against_the_drive_or_across_it() -> None:
    north, south, east = 0.0, np.pi, np.pi / 2.0
    facing = np.array([south, south + 0.7, south + 0.9, north, east, -east, south, east])
    figures = kitti_ts.score_facing(facing, np.full(8, north), np.array([1, 1, 1, 1, 2, 2, 2, 0]))
    assert figures == {"facing_known": 7, "facing_right": round(4 / 7, 4)}


def test_ramps_are_matched_nearest_first() -> None:
    """The most matches would be two: the nearest pair takes the ramp that the other label needs."""
    labels, ramps = np.array([[0.0, 0.0], [2.0, 0.0]]), np.array([[1.2, 0.0], [4.4, 0.0]])
    label, ramp, distance_m = bend_ramps.match_nearest_first(labels, ramps, 1.5)
    assert (label.tolist(), ramp.tolist()) == ([1], [0])
    np.testing.assert_allclose(distance_m, [0.8])


def test_coverage_counts_ramps_near_panoramas_and_ellipses_hold_the_error() -> None:
    ramps = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [60.0, 0.0]])
    labels = np.array([[0.5, 0.0], [10.5, 0.4], [60.5, -0.4], [-20.0, 0.1]])
    # The 95 % ellipse of a sigma of 0.2 m has a radius of 0.49 m.
    covariance = np.tile(np.diag([0.04, 0.04]), (4, 1, 1))
    figures = bend_ramps.score_labels(labels, covariance, ramps, np.array([[0.0, 0.0], [20.0, 0.0]]))
    assert figures == {
        "ramps": 3,
        "labels": 4,
        "matched": 3,
        "covered": round(2 / 3, 4),
        "unmatched": 0.25,
        "median_distance_m": 0.64,
        "sigma_per_axis_m": round(float(np.sqrt(0.32 / 3 / 2)), 3),
        "bias_east_m": 0.5,
        "bias_north_m": 0.0,
        "in_95_ellipse": 0.0,
        "in_95_ellipse_less_bias": 1.0,
        # Moved by 20 m, the labels at 0.5 and -20 m lie near the ramps at 20 and 0 m.
        "matched_by_chance": 0.5,
    }


def test_signs_of_both_methods_are_compared() -> None:
    signs = np.array([[0.0, 0, 0], [10, 0, 0], [20, 0, 0]])
    one = kitti_signs.sign_distances(np.array([[0.5, 0, 0], [10, 1.5, 0], [20, 0, 2.5]]), signs)
    np.testing.assert_allclose(one, [0.5, 1.5, np.nan])
    score = kitti_signs.score_labels(np.array([[0.5, 0, 0], [10, 1.5, 0]]), signs, np.array([True] * 3), signs)
    told = kitti_signs.add_up({"a": score, "b": score}).to_json()
    assert (told["signs_of_both"], told["median_distance_survey_m"]) == (4, 1.0)


def test_sigmas_that_were_not_estimated_are_not_kept() -> None:
    """Poses of this drive are good but for a curve; the smallest sigmas of a start have six labels of two signs."""
    folder = FIELD_DATA / "kitti_signs"
    if not folder.is_dir():
        pytest.skip("the KITTI signs are not on this machine")
    score = kitti_signs.run_sequence(folder, "09", MapConfig(), None)
    assert score.tracks_matched == score.tracks
    assert score.labels <= score.distinct_labels + 1


def test_all_are_run_with_one_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One log of three boxes of one post: whatever the map is, the figures of its table are there."""
    (tmp_path / "av2_static").mkdir()
    write_log(tmp_path / "av2_static")
    results = field.run(tmp_path, MapConfig(method="paper"))
    assert results["av2_static"]["total"]["objects"] == 1
    assert results["av2_static"]["total"]["found"] == 1
    printed = capsys.readouterr()
    assert "recall of 18" in printed.out
    assert "left out: london_tl" in printed.err
    with pytest.raises(InputError, match="none of"):
        field.run(tmp_path / "av2_static", MapConfig())
