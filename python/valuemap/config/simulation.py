"""Settings of `valuemap simulate`."""

from __future__ import annotations

from pydantic.dataclasses import dataclass

from valuemap.config.setting import CHECKED, Settings, declare
from valuemap.errors import SettingError


@dataclass(frozen=True, config=CHECKED)
class SimulationConfig(Settings):
    """A simulated city, its drives, its camera, its detector and all their errors."""

    # The city.
    streets_north_south: int = declare(
        6,
        unit="streets",
        low=2,
        effect="streets that run north to south; with the next, the size of the city",
    )
    streets_east_west: int = declare(6, unit="streets", low=2, effect="streets that run east to west")
    block_east_m: float = declare(
        110.0, unit="m", low=60.0, effect="mean distance between two streets that run north to south"
    )
    block_north_m: float = declare(
        90.0, unit="m", low=60.0, effect="mean distance between two streets that run east to west"
    )
    block_jitter: float = declare(
        0.15, unit="1", high=0.3, effect="blocks are longer or shorter by up to this share of the mean"
    )
    street_width_m: float = declare(
        26.0,
        unit="m",
        low=24.0,
        high=40.0,
        effect="from house front to house front; wider streets see round corners",
    )
    relief_m: float = declare(2.0, unit="m", effect="standard deviation of the height of the ground; 0 is a flat city")
    signalised_share: float = declare(
        0.3, unit="1", high=1.0, effect="share of the intersections that have lights (at least one has)"
    )
    lights: int = declare(
        0, unit="lights", effect="exact number of lights; 0 takes as many as the intersections happen to have"
    )
    min_lights: int = declare(3, unit="lights", low=1, effect="fewest lights of an intersection")
    max_lights: int = declare(8, unit="lights", low=1, high=24, effect="most lights of an intersection")
    lights_per_approach: float = declare(
        1.8, unit="lights", low=1.0, high=8.0, effect="mean number of lights that face the same approach"
    )
    pair_share: float = declare(
        0.25,
        unit="1",
        high=1.0,
        effect="share of poles and mast arms that carry two lights, 0.5 to 0.9 m apart",
    )
    light_width_m: float = declare(0.35, unit="m", open_low=True, effect="width of a light")
    light_height_m: float = declare(1.0, unit="m", open_low=True, effect="height of a light")
    has_lights: int = declare(
        1, unit="0 or 1", high=1, effect="0 builds a city without lights, in which no car waits and all images are kept"
    )

    # What stands in rows along the streets.
    sign_row_spacing_m: float = declare(
        0.0, unit="m", effect="distance along the right side of a street between two rows of signs; 0 for none"
    )
    sign_apart_m: float = declare(
        0.9, unit="m", open_low=True, effect="distance between the middles of two signs side by side"
    )
    min_row_signs: int = declare(2, unit="signs", low=1, effect="fewest signs of a row")
    max_row_signs: int = declare(6, unit="signs", low=1, high=12, effect="most signs of a row")
    lamp_spacing_m: float = declare(
        0.0, unit="m", effect="distance between two street lamps on each side of a street; 0 for none"
    )
    tree_spacing_m: float = declare(
        0.0, unit="m", effect="distance between two trees on each side of a street; 0 for none"
    )
    post_spacing_m: float = declare(
        0.0, unit="m", effect="distance between two posts on each side of a street; 0 for none"
    )
    size_spread: float = declare(
        0.0, unit="1", high=1.0, effect="standard deviation of the logarithm of the size of objects of one class"
    )
    side_offset_m: float = declare(
        0.0,
        unit="m",
        high=2.0,
        effect="deviation of the middle of an object's box from its centre, another way from each side",
    )

    districts: int = declare(
        1,
        unit="cities",
        low=1,
        effect="so many cities side by side, each of its own seed and written before the next, so that any number of "
        "them takes the memory of one; the other settings are those of each",
    )

    # The drives.
    passes_per_street: int = declare(
        2,
        unit="passes",
        effect="every street is driven this often in each direction, before any drives at random",
    )
    images: int = declare(
        0,
        unit="images",
        effect="exact number of images: drives at random follow until it is reached; 0 for no such drives",
    )
    pass_length_m: float = declare(
        3000.0,
        unit="m",
        low=200.0,
        effect="length of a pass; errors of the pose and of the car are of one pass",
    )
    laps: int = declare(
        1,
        unit="laps",
        low=1,
        effect="a pass drives its tour of the streets this often in turn; more than 1 cuts no tours into passes",
    )
    turn_share: float = declare(
        0.35,
        unit="1",
        high=1.0,
        effect="share of intersections at which a drive at random turns (half left, half right)",
    )
    main_street_pull: float = declare(
        0.0,
        unit="1",
        high=3.0,
        effect="how much some streets are preferred: by drives at random, and by the lights of an intersection",
    )
    red_light_share: float = declare(
        0.35, unit="1", high=1.0, effect="share of approaches at which the car has to wait"
    )
    red_light_s: float = declare(20.0, unit="s", effect="mean time it waits; waits are 0.5 to 1.5 times that")
    speed_mps: float = declare(
        8.0, unit="m/s", open_low=True, effect="speed while moving; only timestamps depend on it"
    )
    frame_spacing_m: float = declare(
        2.0,
        unit="m",
        low=0.1,
        high=20.0,
        effect="distance between two images of a moving car; smaller takes more images",
    )
    standing_interval_s: float = declare(
        0.5,
        unit="s",
        low=0.02,
        effect="time between two images of a standing car; smaller takes more alike images",
    )
    keep_before_signal_m: float = declare(
        100.0,
        unit="m",
        low=20.0,
        effect="images farther than this along the street from the next lights ahead are dropped; "
        "larger keeps more images without a detection",
    )
    detections: int = declare(
        0,
        unit="detections",
        effect="aimed number of detections, met by taking keep_before_signal_m between 0.7 and 1.5 times "
        "its value; 0 takes it as it is",
    )

    # The camera.
    image_width_px: int = declare(640, unit="px", low=16, effect="width of the pictures")
    image_height_px: int = declare(480, unit="px", low=16, effect="height of the pictures")
    focal_px: float = declare(500.0, unit="px", open_low=True, effect="focal length; larger sees farther and less wide")
    camera_height_m: float = declare(1.6, unit="m", effect="height of the camera above the street")
    camera_pitch_deg: float = declare(
        3.0, unit="deg", low=-30.0, high=30.0, effect="how far the camera looks up from the street"
    )

    cameras: int = declare(
        1, unit="cameras", low=1, high=8, effect="cameras of each car, each with a camera_id of its own"
    )
    camera_spread_deg: float = declare(
        60.0, unit="deg", high=180.0, effect="angle between the directions in which two neighbouring cameras look"
    )

    # What can be seen.
    max_sight_m: float = declare(
        120.0, unit="m", open_low=True, effect="a light farther than this (on the ground) is not seen"
    )
    min_box_height_px: float = declare(5.0, unit="px", effect="a light lower than this in the picture is not seen")
    max_facing_deg: float = declare(
        65.0,
        unit="deg",
        high=90.0,
        effect="a light that faces away from the camera by more than this is not seen",
    )
    occluded_share: float = declare(
        0.05,
        unit="1",
        high=0.9,
        effect="share of views of a light that traffic hides, in runs of successive images",
    )
    occlusion_s: float = declare(4.0, unit="s", effect="mean time after which traffic hides a light or not anew")
    min_visible_share: float = declare(
        1.0,
        unit="1",
        open_low=True,
        high=1.0,
        effect="what the picture's edge cuts is seen if this share of its box is left, and has a box of the rest",
    )
    partly_hidden_share: float = declare(
        0.0,
        unit="1",
        high=0.9,
        effect="share of views of an object that is hidden in part, in runs: its box is that of the rest",
    )

    # The detector.
    recall_mean: float = declare(
        0.85,
        unit="1",
        open_low=True,
        high=1.0,
        effect="detection rate: share of the lights in view that are detected, mean of the passes",
    )
    recall_sd: float = declare(
        0.06,
        unit="1",
        high=0.45,
        effect="standard deviation of that share between passes (weather, time of day)",
    )
    half_recall_height_px: float = declare(
        3.0,
        unit="px",
        effect="box height at which the detection rate is half; at twice the height 94 % of it; 0 switches off",
    )
    pixel_noise_px: float = declare(1.2, unit="px", effect="standard deviation of a small box's centre, each axis")
    pixel_noise_share: float = declare(
        0.06,
        unit="1",
        high=0.5,
        effect="part of that standard deviation that grows with the box, as share of its height",
    )
    noise_memory_images: float = declare(
        0.0,
        unit="1",
        effect="images of a pass over which errors of the centres of one object's boxes forget 63 % of themselves; "
        "0 for none",
    )
    tail_share: float = declare(
        0.0, unit="1", high=1.0, effect="share of boxes whose centre is far more wrong than that"
    )
    tail_factor: float = declare(
        5.0, unit="1", low=1.0, effect="how many times the standard deviation of such boxes is that of others"
    )
    size_noise: float = declare(
        0.15, unit="1", high=1.0, effect="standard deviation of the logarithm of a box's width and height"
    )
    score_true: float = declare(0.75, unit="1", high=1.0, effect="mean score of a light in a large box")
    score_false: float = declare(0.5, unit="1", high=1.0, effect="mean score of false boxes and of tiny ones")
    score_noise: float = declare(0.12, unit="1", high=1.0, effect="standard deviation of scores (cut to 0 and 1)")
    double_share: float = declare(0.0, unit="1", high=1.0, effect="share of boxes that the detector reports twice")
    double_apart_px: float = declare(1.5, unit="px", effect="distance between the centres of two such boxes")
    class_confusion: float = declare(
        0.0,
        unit="1",
        high=0.9,
        effect="share of boxes of objects that get another class of those that stand in the city",
    )

    # Detections of other things.
    clutter_per_image: float = declare(
        0.05, unit="boxes", effect="mean number of random false boxes per image, each in one image only"
    )
    reflections_per_1000_images: float = declare(
        0.6,
        unit="1",
        effect="false objects fixed to the car, at one place of the picture for a stretch of a pass",
    )
    reflection_images: float = declare(
        25.0, unit="images", low=1.0, effect="mean number of images in which such a reflection stays"
    )
    temporary_per_1000_images: float = declare(
        0.1, unit="1", effect="false objects in the world that only one pass meets, such as a van's lamp"
    )
    temporary_recall: float = declare(
        0.6,
        unit="1",
        high=1.0,
        effect="how often a temporary object is detected, as share of the detection rate of lights",
    )
    lookalikes_per_light: float = declare(
        0.02,
        unit="1",
        effect="false objects that stay, look like lights and are met by every pass; 0 for none",
    )
    lookalike_recall: float = declare(
        0.4, unit="1", high=1.0, effect="how often a lookalike is detected, as share of the detection rate of lights"
    )

    # The errors of the poses.
    position_white_m: float = declare(
        0.072,
        unit="m",
        effect="standard deviation of a camera position, each axis: part of each image of its own",
    )
    position_drift_m: float = declare(
        0.096,
        unit="m",
        effect="standard deviation of a camera position, each axis: part that drifts along a pass",
    )
    rotation_white_deg: float = declare(
        0.09, unit="deg", effect="standard deviation of a rotation, each axis: part of each image of its own"
    )
    rotation_drift_deg: float = declare(
        0.12, unit="deg", effect="standard deviation of a rotation, each axis: part that drifts along a pass"
    )
    drift_length_m: float = declare(
        100.0, unit="m", open_low=True, effect="distance over which drifting errors forget 63 % of themselves"
    )
    position_middle_m: float = declare(
        0.0,
        unit="m",
        effect="standard deviation of a camera position, each axis: part that drifts over middle_length_m",
    )
    rotation_middle_deg: float = declare(
        0.0, unit="deg", effect="standard deviation of a rotation, each axis: part that drifts over middle_length_m"
    )
    middle_length_m: float = declare(
        15.0, unit="m", open_low=True, effect="distance over which those errors forget 63 % of themselves"
    )
    pass_shift_m: float = declare(
        0.0, unit="m", effect="each pass is shifted by this much on the ground, in a direction of its own"
    )
    pass_height_m: float = declare(0.0, unit="m", effect="each pass is higher or lower by this much")
    pass_yaw_deg: float = declare(
        0.0, unit="deg", effect="each pass is turned by this much, left or right, as by a camera mounted askew"
    )
    jump_m: float = declare(
        0.0, unit="m", effect="poses jump by this much on the ground, and back again later, jumps_per_km times"
    )
    jumps_per_km: float = declare(5.0, unit="1", effect="how often they jump or jump back, in each km of a pass")
    pose_delay_s: float = declare(
        0.0, unit="s", high=10.0, effect="the recorded pose is that of so much time before the image was taken"
    )
    focal_error_share: float = declare(
        0.0, unit="1", low=-0.5, high=0.5, effect="the recorded focal length is too long by this share of itself"
    )
    readout_s: float = declare(
        0.0, unit="s", high=0.2, effect="the last row of a picture is exposed so much later than the first one"
    )

    # What is recorded.
    write_pose_sigmas: int = declare(
        0, unit="0 or 1", high=1, effect="1 writes the standard deviations of the poses into images.parquet"
    )
    write_timestamps: int = declare(1, unit="0 or 1", high=1, effect="0 leaves the time out of images.parquet")
    write_rigs: int = declare(
        0, unit="0 or 1", high=1, effect="1 writes into images.parquet which images a car took at one time (rig_id)"
    )
    camera_folders: int = declare(
        0,
        unit="0, 1 or 2",
        high=2,
        effect="names with several cameras: 0 is PASS/CAMERA/NUMBER.jpg, 1 CAMERA/PASS/NUMBER.jpg, 2 PASS-CAMERA/...",
    )
    pass_per_camera: int = declare(
        0, unit="0 or 1", high=1, effect="1 gives the images of each camera a pass_id of their own"
    )
    shuffle_ids: int = declare(
        0, unit="0 or 1", high=1, effect="1 numbers images and detections at random, not in the order of time"
    )
    shuffle_names: int = declare(
        0, unit="0 or 1", high=1, effect="1 numbers the files of images at random, not in the order of time"
    )

    def __post_init__(self) -> None:
        if self.images == 0 and self.passes_per_street == 0:
            raise SettingError(
                "images and passes_per_street are both 0, so nobody drives",
                hint="--set passes_per_street=2 drives every street; --set images=1000 drives at random",
            )
        if self.min_lights > self.max_lights:
            raise SettingError(
                f"min_lights ({self.min_lights}) must be at most max_lights ({self.max_lights})",
                hint="set both, e.g. --set min_lights=3 --set max_lights=8",
            )
        if self.min_row_signs > self.max_row_signs:
            raise SettingError(
                f"min_row_signs ({self.min_row_signs}) must be at most max_row_signs ({self.max_row_signs})",
                hint="set both, e.g. --set min_row_signs=2 --set max_row_signs=6",
            )
        rows = (self.sign_row_spacing_m, self.lamp_spacing_m, self.tree_spacing_m, self.post_spacing_m)
        if self.class_confusion and sum(spacing > 0.0 for spacing in (self.has_lights, *rows)) < 2:
            raise SettingError(
                f"class_confusion ({self.class_confusion}): only one class stands in the city",
                hint="--set sign_row_spacing_m=50 puts signs along the streets as well",
            )
        if not self.has_lights and not any(rows):
            raise SettingError(
                "has_lights and all spacings of signs, lamps, trees and posts are 0, so nothing stands in the city",
                hint="--set post_spacing_m=10 puts posts along the streets",
            )
        if self.recall_sd > 0.0 and self.recall_sd**2 >= self.recall_mean * (1.0 - self.recall_mean):
            raise SettingError(
                f"recall_sd ({self.recall_sd}) is too large for recall_mean ({self.recall_mean})",
                hint="a share between 0 and 1 cannot vary so much: take a smaller recall_sd, or 0",
            )

    def check_drawable(self) -> None:
        """Raise `SettingError` where pictures could not show what is simulated."""
        rows = ("sign_row_spacing_m", "lamp_spacing_m", "tree_spacing_m", "post_spacing_m")
        for name in (*rows, "side_offset_m", "partly_hidden_share", "cameras", "districts"):
            default = getattr(SimulationConfig(), name)
            if getattr(self, name) != default:
                raise SettingError(
                    f"{name} ({getattr(self, name)}): pictures are drawn by one camera of whole, flat lights only",
                    hint=f"leave --images away, or --set {name}={default}",
                )
