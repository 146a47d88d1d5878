"""Pictures without poses: their tags, written here with Pillow, and structure from motion on a street drawn here."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from scipy.spatial.transform import Rotation

from reading import refusal, write
from valuemap.cameras import camera_centers, rotation_matrices
from valuemap.errors import InputError
from valuemap.readers.exif import read_exif
from valuemap.readers.pictures import read_pictures
from valuemap.readers.structure import Picture, Posed, similarity_onto

ANCHOR = (52.0, 4.0, 40.0)
WIDE = {"FocalLengthIn35mmFilm": 26}


def sexagesimal(degrees: float) -> tuple[float, float, float]:
    whole = int(degrees)
    minutes = int((degrees - whole) * 60)
    return float(whole), float(minutes), (degrees - whole - minutes / 60) * 3600


def tags(lat: float, lon: float, height: float = 40.0, **more: Any) -> Image.Exif:
    """EXIF tags with a GPS position, and what else is named as GPS_..., EXIF_... or by its number."""
    exif = Image.Exif()
    exif[Base.Software] = "a test"  # Without a tag of its own Pillow writes none.
    gps: dict[int, Any] = {
        GPS.GPSLatitudeRef: "N" if lat >= 0 else "S",
        GPS.GPSLatitude: sexagesimal(abs(lat)),
        GPS.GPSLongitudeRef: "E" if lon >= 0 else "W",
        GPS.GPSLongitude: sexagesimal(abs(lon)),
        GPS.GPSAltitudeRef: b"\x00" if height >= 0 else b"\x01",
        GPS.GPSAltitude: abs(height),
    }
    own: dict[int, Any] = {}
    for name, value in more.items():
        if name in GPS.__members__:
            gps[GPS[name]] = value
        elif name in ("Make", "Model", "Orientation"):
            exif[Base[name]] = value
        else:
            own[Base[name]] = value
    exif._ifds[IFD.GPSInfo], exif._ifds[IFD.Exif] = gps, own
    return exif


def picture(path: Path, exif: Image.Exif | None = None, size: tuple[int, int] = (64, 48), **options: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size).save(path, exif=Image.Exif() if exif is None else exif, **options)
    return path


# Tags.


def test_tags_of_a_picture(tmp_path: Path) -> None:
    exif = tags(
        -33.5,
        -70.25,
        -12.0,
        GPSImgDirection=271.5,
        GPSHPositioningError=2.5,
        GPSDateStamp="2023:11:14",
        GPSTimeStamp=(22.0, 13.0, 20.5),
        FocalLengthIn35mmFilm=27,
        Orientation=6,
        Model="A",
    )
    found = read_exif(picture(tmp_path / "a.jpg", exif, (400, 300)))
    assert (found.width, found.height) == (400, 300)
    assert found.lat_lon is not None
    assert_allclose(np.array(found.lat_lon), [-33.5, -70.25], atol=1e-9)
    assert (found.height_m, found.sigma_m, found.heading_deg, found.roll_deg) == (-12.0, 2.5, 271.5, 90.0)
    assert (found.gps_time_s, found.camera_time_s) == (1_700_000_000.5, None)
    # A film is 36 by 24 mm, and what is said of it is the angle from corner to corner.
    assert found.focal_px == pytest.approx(27 / np.hypot(36.0, 24.0) * 500.0)
    assert not found.is_panorama


def test_times_of_a_camera_with_a_zone_and_parts_of_a_second(tmp_path: Path) -> None:
    options: dict[str, Any] = {
        "DateTimeOriginal": "2023:11:14 23:13:20",
        "OffsetTimeOriginal": "+01:00",
        "SubsecTimeOriginal": "25",
    }
    assert read_exif(picture(tmp_path / "a.jpg", tags(1, 2, **options))).camera_time_s == 1_700_000_000.25
    assert read_exif(picture(tmp_path / "b.jpg", tags(1, 2, DateTimeOriginal="yesterday"))).camera_time_s is None


def test_tags_that_make_no_sense_are_taken_for_missing(tmp_path: Path) -> None:
    exif = tags(0.0, 0.0, GPSHPositioningError=0.0, FocalLengthIn35mmFilm=0)
    found = read_exif(picture(tmp_path / "a.jpg", exif))
    assert (found.lat_lon, found.heading_deg, found.sigma_m, found.focal_px) == (None, None, None, None)


def test_a_panorama_says_so_in_its_xmp(tmp_path: Path) -> None:
    attributes = 'GPano:ProjectionType="equirectangular" GPano:PoseHeadingDegrees="90.5" GPano:PoseRollDegrees="-2"'
    elements = (
        "<GPano:ProjectionType>equirectangular</GPano:ProjectionType><GPano:PosePitchDegrees>3</GPano:PosePitchDegrees>"
    )
    for name, body in (("a.jpg", f"<rdf:Description {attributes}/>"), ("b.jpg", elements)):
        found = read_exif(picture(tmp_path / name, tags(1, 2), (64, 32), xmp=f"<x>{body}</x>".encode()))
        assert found.is_panorama
        assert not found.is_cut
    first = read_exif(tmp_path / "a.jpg")
    assert (first.heading_deg, first.pitch_deg, first.roll_deg) == (90.5, 0.0, -2.0)
    assert read_exif(tmp_path / "b.jpg").pitch_deg == 3.0


def test_panoramas_that_a_phone_was_swept_round_for_are_not_taken_for_flat_pictures(tmp_path: Path) -> None:
    more: dict[str, Any] = {"GPSImgDirection": 90.0, "FocalLengthIn35mmFilm": 26}
    picture(tmp_path / "a.jpg", tags(52.0, 4.0, **more))
    picture(tmp_path / "apple.jpg", tags(52.0001, 4.0, **more, CustomRendered=6), (96, 24))
    xmp = b'<x GPano:ProjectionType="cylindrical"/>'
    picture(tmp_path / "android.jpg", tags(52.0002, 4.0, **more), (96, 24), xmp=xmp)
    dataset = read_pictures(tmp_path, poses="exif", max_rejected=0.7)
    assert dataset.images.name.to_pylist() == ["a.jpg"]
    assert dataset.rejected is not None
    assert {reason[:26] for reason in dataset.rejected.reason.texts()} == {"is a panorama that is cut:"}


@pytest.mark.parametrize(("direction", "heading"), [(123.0, 123.0), (0.0, 0.0), (None, 10.0)])
def test_the_heading_of_the_gps_counts_before_that_of_gpano(
    tmp_path: Path, direction: float | None, heading: float
) -> None:
    """Cameras without a compass write a heading of 0, or of the sphere's own north, into GPano."""
    xmp = b'<x GPano:ProjectionType="equirectangular" GPano:PoseHeadingDegrees="10" GPano:PosePitchDegrees="2"/>'
    more = {} if direction is None else {"GPSImgDirection": direction}
    picture(tmp_path / "a.jpg", tags(52.0, 4.0, **more), (64, 32), xmp=xmp)
    said: list[str] = []
    dataset = read_pictures(tmp_path, tell=said.append)
    forward = rotation_matrices(dataset.images)[0][2]
    level = np.array([np.sin(np.radians(heading)), np.cos(np.radians(heading))]) * np.cos(np.radians(2.0))
    assert_allclose(forward, [*level, np.sin(np.radians(2.0))], atol=1e-9)
    assert len(said) == (direction is not None)
    assert all("1 pictures have another heading in PoseHeadingDegrees" in line for line in said)


def asked_for(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the names of the pictures of a folder whose poses structure from motion is asked for, which finds none."""
    asked: list[str] = []

    def find_poses(pictures: list[Picture], *_: Any, **__: Any) -> Posed:
        asked.extend(each.name for each in pictures)
        raise InputError("asked", hint="nothing")

    monkeypatch.setattr("valuemap.readers.pictures.find_poses", find_poses)
    assert refusal(lambda: read_pictures(folder, workspace=folder / "work")) == "asked | nothing"
    return asked


def test_only_headings_that_are_used_and_differ_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By 0.8 degrees across north they are the same, by 1.2 not; those of flat pictures say nothing of their poses."""
    pano = 'GPano:ProjectionType="equirectangular" GPano:PoseHeadingDegrees='
    for name, direction, xmp in (
        ("same.jpg", 359.6, f'<x {pano}"0.4"/>'),
        ("other.jpg", 359.4, f'<x {pano}"0.6"/>'),
        ("once.jpg", 20.0, '<x GPano:ProjectionType="equirectangular"/>'),
    ):
        picture(tmp_path / name, tags(52.0, 4.0, GPSImgDirection=direction), (64, 32), xmp=xmp.encode())
    gimbal = b'<rdf:Description drone-dji:GimbalYawDegree="+90.00" drone-dji:GimbalPitchDegree="-1.00"/>'
    flat = tags(52.0001, 4.0, GPSImgDirection=10.0, FocalLengthIn35mmFilm=24)
    picture(tmp_path / "flat.jpg", flat, xmp=gimbal)
    said: list[str] = []
    read_pictures(tmp_path, poses="exif", tell=said.append)
    assert [line.split(" have")[0] for line in said] == ["2 pictures"]

    def find_poses(*_: Any, **__: Any) -> Posed:
        raise InputError("asked", hint="nothing")

    monkeypatch.setattr("valuemap.readers.pictures.find_poses", find_poses)
    said.clear()
    refusal(lambda: read_pictures(tmp_path, workspace=tmp_path / "work", tell=said.append))
    assert [line.split(" have")[0] for line in said] == ["1 pictures"]


def test_the_gimbal_of_a_drone_says_where_its_camera_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """East and down by 30 degrees; straight down; and level by the tags of a drone that does not know."""
    for name, yaw, pitch in (("30.jpg", "+90.00", "-30.00"), ("90.jpg", "+90.00", "-90.00"), ("0.jpg", "0.0", "+0.0")):
        angles = f'drone-dji:GimbalYawDegree="{yaw}" drone-dji:GimbalPitchDegree="{pitch}"'
        xmp = f'<rdf:Description {angles} drone-dji:GimbalRollDegree="+0.00"/>'.encode()
        lat = 52.0 + abs(float(pitch)) * 1e-5
        picture(tmp_path / name, tags(lat, 4.0, FocalLengthIn35mmFilm=24), xmp=xmp)
    assert read_exif(tmp_path / "0.jpg").heading_deg is None
    images = read_pictures(tmp_path, poses="exif", max_rejected=0.5).images
    assert images.name.to_pylist() == ["30.jpg", "90.jpg"]
    slant, down = rotation_matrices(images)
    assert_allclose(slant[2], [np.cos(np.radians(30.0)), 0.0, -0.5], atol=1e-4)
    assert_allclose(down[2], [0.0, 0.0, -1.0], atol=1e-4)
    assert_allclose(down[1], [-1.0, 0.0, 0.0], atol=1e-4)  # What is below in the picture is behind the drone.
    asked = asked_for(tmp_path, monkeypatch)
    assert asked == ["0.jpg", "30.jpg"]
    # Of a panorama it says where the last picture of it looked.
    sphere = xmp.replace(b"drone-dji:GimbalRoll", b'GPano:ProjectionType="equirectangular" drone-dji:GimbalRoll')
    found = read_exif(
        picture(tmp_path / "sphere" / "a.jpg", tags(52.0, 4.0), (64, 32), xmp=sphere.replace(b"0.0", b"9.0"))
    )
    assert (found.heading_deg, found.pitch_deg) == (None, 0.0)


def test_pictures_of_the_shape_of_panoramas_are_not_taken_for_flat_ones(tmp_path: Path) -> None:
    """Programs that blur or shrink pictures lose the tags that say so."""
    picture(tmp_path / "a.jpg", tags(52.0, 4.0, GPSImgDirection=90.0), (64, 32))
    assert "as panoramas are, and no tag says what it is: say it with --camera" in refusal(
        lambda: read_pictures(tmp_path, poses="exif")
    )
    assert read_pictures(tmp_path, camera="EQUIRECTANGULAR 64 32").cameras.model.texts() == ["EQUIRECTANGULAR"]
    picture(tmp_path / "a.jpg", tags(52.0, 4.0, GPSImgDirection=90.0, FocalLengthIn35mmFilm=26), (64, 32))
    assert read_pictures(tmp_path, poses="exif").cameras.model.texts() == ["SIMPLE_RADIAL"]


def test_pictures_in_a_format_that_is_not_read_are_listed(tmp_path: Path) -> None:
    """Phones keep pictures as HEIC, some beside a JPEG of the same name, which counts."""
    for name, lat in (("a.jpg", 52.0), ("b.JPG", 52.0001)):
        picture(tmp_path / name, tags(lat, 4.0, GPSImgDirection=90.0, **WIDE), format="JPEG")
    for name in ("b.HEIC", "c.heic"):
        write(tmp_path / name, "ftypheic")
    assert "1 of 3 pictures cannot be used: c.heic: is HEIC, which is not read" in refusal(
        lambda: read_pictures(tmp_path, poses="exif")
    )
    dataset = read_pictures(tmp_path, poses="exif", max_rejected=0.5)
    assert dataset.images.name.to_pylist() == ["a.jpg", "b.JPG"]
    assert dataset.rejected is not None
    assert dataset.rejected.image_name.to_pylist() == ["c.heic"]
    for name in ("a.jpg", "b.JPG"):
        (tmp_path / name).unlink()
    assert "2 of 2 pictures cannot be used" in refusal(lambda: read_pictures(tmp_path, poses="exif"))


def test_the_description_of_mapillarys_programs_says_what_the_gps_tags_do_not(tmp_path: Path) -> None:
    described = {
        "MAPLatitude": 52.5,
        "MAPLongitude": -4.25,
        "MAPAltitude": 12.5,
        "MAPCaptureTime": "2023_11_14_22_13_20_250",
        "MAPCompassHeading": {"TrueHeading": 33.5, "MagneticHeading": 30.0},
    }
    bare, full = Image.Exif(), tags(52.0, 4.0, GPSImgDirection=90.0, DateTimeOriginal="2023:11:14 22:13:21")
    for name, exif in (("bare.jpg", bare), ("full.jpg", full)):
        exif[Base.ImageDescription] = json.dumps(described)
        picture(tmp_path / name, exif)
    first, second = read_exif(tmp_path / "bare.jpg"), read_exif(tmp_path / "full.jpg")
    assert (first.lat_lon, first.height_m, first.heading_deg) == ((52.5, -4.25), 12.5, 33.5)
    assert first.camera_time_s == 1_700_000_000.25
    assert (second.lat_lon, second.height_m, second.heading_deg) == ((52.0, 4.0), 40.0, 90.0)
    assert second.camera_time_s == 1_700_000_001.0
    exif = tags(52.0, 4.0)
    del exif.get_ifd(IFD.GPSInfo)[GPS.GPSLatitude]
    exif[Base.ImageDescription] = json.dumps(described)
    third = read_exif(
        picture(
            tmp_path / "third.jpg",
            exif,
            (64, 32),
            xmp=b'<x GPano:ProjectionType="equirectangular" GPano:PoseHeadingDegrees="0"/>',
        )
    )
    assert (third.lat_lon, third.height_m, third.heading_deg) == ((52.5, -4.25), 12.5, 33.5)
    huge = "9" * 400
    for odd in (
        *("a street", "[1]", "{" * 100_000),
        '{"MAPLatitude": "x", "MAPCompassHeading": 3, "MAPCaptureTime": 5}',
        f'{{"MAPLatitude": {huge}, "MAPCaptureTime": "2023_11_14_22_13_20_{huge}"}}',
        '{"MAPCompassHeading": {"TrueHeading": -1, "MagneticHeading": 30}}',  # A telephone that does not know it.
    ):
        exif = Image.Exif()
        exif[Base.ImageDescription] = odd
        found = read_exif(
            picture(tmp_path / "odd.jpg", exif) if len(odd) < 1000 else picture(tmp_path / "odd.png", exif)
        )
        assert (found.lat_lon, found.heading_deg, found.camera_time_s) == (None, None, None)


def panorama(path: Path, size: tuple[int, int], lat: float, **pano: float) -> Path:
    attributes = "".join(f' GPano:{name}="{value}"' for name, value in pano.items())
    xmp = f'<x><rdf:Description GPano:ProjectionType="equirectangular"{attributes}/></x>'
    return picture(path, tags(lat, 4.0), size, xmp=xmp.encode())


def test_panoramas_that_are_cut_are_listed_and_left_out(tmp_path: Path) -> None:
    """By their tags, by their shape alone, or by both; one made smaller may be a pixel off."""
    full = {"FullPanoWidthPixels": 128, "FullPanoHeightPixels": 64, "PoseHeadingDegrees": 90}
    panorama(tmp_path / "whole.jpg", (129, 64), 52.0, **full, CroppedAreaImageHeightPixels=64)
    panorama(tmp_path / "wide.jpg", (128, 64), 52.0001, **full, CroppedAreaImageWidthPixels=96)
    panorama(tmp_path / "low.jpg", (128, 40), 52.0002, **full, CroppedAreaImageHeightPixels=40)
    panorama(tmp_path / "untold.jpg", (128, 40), 52.0003, PoseHeadingDegrees=90)
    dataset = read_pictures(tmp_path, max_rejected=0.9)
    assert dataset.images.name.to_pylist() == ["whole.jpg"]
    assert dataset.rejected is not None
    assert sorted(dataset.rejected.image_name.to_pylist()) == ["low.jpg", "untold.jpg", "wide.jpg"]
    assert all("a panorama that is cut" in reason for reason in dataset.rejected.reason.texts())
    assert "3 of 4 pictures cannot be used" in refusal(lambda: read_pictures(tmp_path))
    assert len(read_pictures(tmp_path, camera="EQUIRECTANGULAR 128 64").images) == 4


def test_pictures_without_the_time_of_the_gps_have_the_corrected_one_of_the_camera(tmp_path: Path) -> None:
    """A camera's clock is two hours and some seconds ahead; in another folder nobody knows."""

    def taken(name: str, minute: int, *, off_s: float | None = None) -> None:
        gps: dict[str, Any] = {}
        if off_s is not None:
            gps = {"GPSDateStamp": "2023:11:14", "GPSTimeStamp": (20.0, float(minute), 10.0 - off_s)}
        local = f"2023:11:14 22:{minute:02d}:10"
        lat = 52.0 + minute * 1e-4
        picture(tmp_path / name, tags(lat, 4.0, GPSImgDirection=0.0, DateTimeOriginal=local, **WIDE, **gps))

    taken("a/3.jpg", 1, off_s=5.0)
    taken("a/2.jpg", 2)
    taken("a/1.jpg", 3, off_s=4.0)
    taken("a/0.jpg", 4, off_s=6.0)
    taken("b/0.jpg", 1)
    taken("b/1.jpg", 2)
    images = read_pictures(tmp_path, poses="exif").images
    assert images.timestamp_s is not None
    at_20 = 1_699_992_000.0
    expected = {
        "a/3.jpg": 65.0,
        "a/2.jpg": 125.0,
        "a/1.jpg": 186.0,
        "a/0.jpg": 244.0,
        "b/0.jpg": 7270.0,
        "b/1.jpg": 7330.0,
    }
    found = dict(zip(images.name.to_pylist(), (images.timestamp_s - at_20).tolist(), strict=True))
    assert found == expected


def test_altitudes_above_the_sea_are_brought_to_the_ellipsoid(tmp_path: Path) -> None:
    """Those that EXIF 3.0 says to be above the ellipsoid (0, 1) stay; there 2 and 3 are above and below the sea."""
    references = [
        (b"\x00", b"0232", 10.0),
        (b"\x01", b"0232", -10.0),
        (b"\x00", b"0300", 10.0),
        (b"\x03", b"0300", -10.0),
    ]
    for number, (reference, version, _) in enumerate(references):
        more: dict[str, Any] = {"GPSAltitudeRef": reference, "ExifVersion": version, "GPSImgDirection": 0.0, **WIDE}
        picture(tmp_path / f"{number}.jpg", tags(52.0 + number * 1e-4, 4.0, 10.0, **more))
    without = tags(52.0005, 4.0, GPSImgDirection=0.0, **WIDE)
    del without._ifds[IFD.GPSInfo][GPS.GPSAltitude]
    picture(tmp_path / "4.jpg", without)
    assert read_exif(tmp_path / "4.jpg").height_m is None

    def heights(vertical: str | None) -> list[float]:
        images = read_pictures(tmp_path, poses="exif", vertical=vertical, anchor=(52.0, 4.0, 0.0)).images
        found: list[float] = camera_centers(images)[:, 2].round(2).tolist()
        return found

    assert heights(None) == [10.0, -10.0, 10.0, -10.0, 0.0]
    assert heights("40") == [50.0, 30.0, 10.0, 30.0, 30.0]


# Headings as they are.


def test_pictures_with_a_heading_are_taken_as_they_are(tmp_path: Path) -> None:
    """Looking east: x right is south, y down is down; turned by EXIF 6 its right side was down."""
    picture(tmp_path / "a" / "1.jpg", tags(52.0, 4.0, GPSImgDirection=90.0, FocalLengthIn35mmFilm=36))
    turned = tags(52.0001, 4.0, 41.0, GPSImgDirection=90.0, Orientation=6, FocalLengthIn35mmFilm=18)
    picture(tmp_path / "a" / "2.jpg", turned)
    picture(tmp_path / "a" / "no heading.jpg", tags(52.0002, 4.0))
    picture(tmp_path / "b" / "no place.jpg")
    dataset = read_pictures(tmp_path, poses="exif")
    assert dataset.images.name.to_pylist() == ["a/1.jpg", "a/2.jpg"]
    assert dataset.images.pass_id.texts() == ["a", "a"]
    assert dataset.frame.anchor is not None
    assert_allclose(dataset.frame.anchor, ANCHOR, atol=1e-9)
    level, rolled = rotation_matrices(dataset.images)
    assert_allclose(level, [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-9)
    assert_allclose(rolled[2], [1, 0, 0], atol=1e-4)
    assert_allclose(rolled[0], [0, 0, -1], atol=1e-4)
    assert_allclose(camera_centers(dataset.images)[1], [0.0, 11.1273, 1.0], atol=1e-3)
    params_of = dict(zip(dataset.cameras.camera_id.tolist(), dataset.cameras.params, strict=True))
    focal = [params_of[camera][0] for camera in dataset.images.camera_id.tolist()]
    assert_allclose(focal, np.array([36.0, 18.0]) / np.hypot(36.0, 24.0) * 80.0)
    assert dataset.images.position_sigma_m is not None
    assert_allclose(dataset.images.position_sigma_m, 3.0)


def test_pictures_without_a_focal_length_are_left_out_where_nothing_estimates_it(tmp_path: Path) -> None:
    for number, more in enumerate((WIDE, {}, {})):
        picture(tmp_path / f"{number}.jpg", tags(52.0 + 1e-4 * number, 4.0, GPSImgDirection=90.0, **more))
    dataset = read_pictures(tmp_path, poses="exif")
    assert dataset.images.name.to_pylist() == ["0.jpg"]
    assert dataset.rejected is not None
    assert dataset.rejected.image_name.to_pylist() == ["1.jpg", "2.jpg"]
    assert all("it has no focal length" in reason for reason in dataset.rejected.reason.texts())
    (tmp_path / "0.jpg").unlink()
    said = refusal(lambda: read_pictures(tmp_path, poses="exif"))
    assert "none of 2 pictures has a pose; of the first: it has no focal length" in said
    assert "give --camera" in said
    assert len(read_pictures(tmp_path, poses="exif", camera="SIMPLE_PINHOLE 64 48 50 32 24").images) == 2


def test_pictures_may_all_be_taken_upright(tmp_path: Path) -> None:
    for number in range(3):
        picture(
            tmp_path / f"{number}.jpg", tags(52.0 + 1e-4 * number, 4.0, GPSImgDirection=90.0, Orientation=6, **WIDE)
        )
    dataset = read_pictures(tmp_path, poses="exif")
    right = rotation_matrices(dataset.images)[:, 0]
    assert_allclose(right, np.tile([0.0, 0.0, -1.0], (3, 1)), atol=1e-4)


def test_structure_from_motion_leaves_out_pictures_taken_on_their_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number, orientation in enumerate((1, 6, 1, 8)):
        picture(tmp_path / f"{number}.jpg", tags(52.0 + 1e-4 * number, 4.0, Orientation=orientation))
    asked = asked_for(tmp_path, monkeypatch)
    assert asked == ["0.jpg", "2.jpg"]
    for name in asked:
        (tmp_path / name).unlink()
    assert "none of 2 pictures has a pose; of the first: it was taken on its side" in refusal(
        lambda: read_pictures(tmp_path, workspace=tmp_path / "work")
    )


def test_panoramas_need_no_structure_from_motion(tmp_path: Path) -> None:
    xmp = b'<x GPano:ProjectionType="equirectangular" GPano:PoseHeadingDegrees="180"/>'
    picture(tmp_path / "p.jpg", tags(52.0, 4.0), (64, 32), xmp=xmp)
    dataset = read_pictures(tmp_path)
    assert dataset.cameras.model.texts() == ["EQUIRECTANGULAR"]
    assert_allclose(rotation_matrices(dataset.images)[0][2], [0, -1, 0], atol=1e-9)


def test_damaged_pictures_are_counted_together(tmp_path: Path) -> None:
    picture(tmp_path / "a.jpg", tags(52.0, 4.0, GPSImgDirection=90.0, **WIDE))
    for name in ("b.jpg", "c.jpg"):
        write(tmp_path / name, "hello")
    rejected = read_pictures(tmp_path, poses="exif", max_rejected=0.9).rejected
    assert rejected is not None
    assert set(rejected.reason.texts()) == {"cannot be read as a picture: cannot identify image file"}
    assert rejected.place.to_pylist() == [f"{tmp_path}/{name}" for name in ("b.jpg", "c.jpg")]


def test_folders_that_cannot_be_used(tmp_path: Path) -> None:
    assert "no such folder" in refusal(lambda: read_pictures(tmp_path / "absent"))
    assert "there are no pictures in it" in refusal(lambda: read_pictures(tmp_path))
    picture(tmp_path / "a.jpg")
    assert "none of 1 pictures has a GPS position" in refusal(lambda: read_pictures(tmp_path))
    picture(tmp_path / "a.jpg", tags(52.0, 4.0, **WIDE))
    assert "no picture has a heading" in refusal(lambda: read_pictures(tmp_path, poses="exif"))
    assert "needs a folder to work in" in refusal(lambda: read_pictures(tmp_path))
    write(tmp_path / "b.jpg", "hello")
    said = refusal(lambda: read_pictures(tmp_path, poses="exif"))
    assert "1 of 2 pictures cannot be used: b.jpg: cannot be read as a picture: cannot identify image file" in said
    (tmp_path / "b.jpg").unlink()
    outside = picture(tmp_path.parent / f"{tmp_path.name}-outside.jpg", tags(52.0, 4.0))
    (tmp_path / "b.jpg").symlink_to(outside)
    assert "is a link that leads out of" in refusal(lambda: read_pictures(tmp_path, poses="exif"))
    (tmp_path / "b.jpg").unlink()
    whole = picture(tmp_path / "b.jpg", tags(52.0, 4.0), (640, 480)).read_bytes()
    (tmp_path / "b.jpg").write_bytes(whole[: len(whole) // 2])
    assert "b.jpg: is cut off or damaged" in refusal(lambda: read_pictures(tmp_path, poses="exif"))
    # A header that promises 30,000 x 30,000 pixels.
    (tmp_path / "b.jpg").write_bytes(whole.replace(b"\x01\xe0\x02\x80", b"\x75\x30\x75\x30"))
    assert "b.jpg: " in refusal(lambda: read_pictures(tmp_path, poses="exif"))
    assert "poses compass" in refusal(lambda: read_pictures(tmp_path, poses="compass"))  # type: ignore[arg-type]


# Onto the Earth.


@pytest.mark.parametrize("straight", [False, True])
def test_a_model_comes_onto_the_gps_with_its_up_on_the_vertical(straight: bool) -> None:
    """Along one straight street the positions alone do not say which way is up; one GPS position is 300 m off."""
    random = np.random.default_rng(0)
    world = np.cumsum(random.normal([2.0, 1.0, 0.0], [0.1, 0.0 if straight else 1.0, 0.0], (60, 3)), axis=0)
    world[:, 2] = 0.0
    if straight:
        world[:, 1] = world[:, 0] / 2.0
    turn = Rotation.from_euler("xyz", [1.0, -2.0, 0.5]).as_matrix()
    model = 0.1 * (world - [5.0, 6.0, 7.0]) @ turn
    up = np.tile([0.0, 0.0, 1.0], (60, 1)) @ turn
    gps = world + random.normal(0.0, 0.5, world.shape)
    gps[7] += [300.0, 0.0, 0.0]
    gps[9] = np.nan
    found = similarity_onto(model, up, gps, np.full(60, 0.5))
    assert found is not None
    scale, rotation, shift = found
    assert_allclose(scale, 10.0, rtol=0.01)
    assert_allclose(rotation @ turn.T @ np.array([0.0, 0.0, 1.0]), [0, 0, 1], atol=0.02)
    assert np.linalg.norm(scale * model @ rotation.T + shift - world, axis=1).max() < 1.0
    assert similarity_onto(model[:2], up[:2], gps[:2], np.ones(2)) is None
    assert similarity_onto(np.zeros((9, 3)), up[:9], gps[10:19], np.ones(9)) is None
