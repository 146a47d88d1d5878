"""All faults that are known, in the order in which they are looked for: a new one is a class and a line here."""

from __future__ import annotations

from valuemap.check.arms import LeverArms
from valuemap.check.boxes import (
    CornersAsCenter,
    HalfSizes,
    ImpossibleBoxes,
    MirroredPictures,
    NormalisedBoxes,
    PanoramaMiddle,
    PictureSize,
    TopLeftAsCenter,
)
from valuemap.check.cameras import CameraAside, CameraHeight, CameraTilt, CameraYaw, FocalLength, TimeShift
from valuemap.check.carried import CarriedBoxes
from valuemap.check.chords import InterpolatedPositions
from valuemap.check.distortion import LensModel
from valuemap.check.drive_ids import InterleavedPasses, NoDrives
from valuemap.check.fault import Convention, Fault
from valuemap.check.frames import (
    ConstantHeadings,
    DegreesForRadians,
    HeadingConvention,
    HeadingsUseless,
    LatLonSwapped,
    MirroredPositions,
    MirroredWorld,
    RotationSigmaUnit,
    Scale,
    TiltConvention,
    UpDirection,
    WorldAxes,
)
from valuemap.check.half_pixel import HalfPixel
from valuemap.check.handedness import MirroredByTruth
from valuemap.check.heights import HeightsLeftOut, HeightUnit, SmallHeightUnit
from valuemap.check.lenses import FocalUnit, PrincipalPoint, SidesExchanged
from valuemap.check.mounts import CameraMount, CamerasExchanged, InvertedMounts
from valuemap.check.names import TwoNames
from valuemap.check.pass_frames import PassFrame
from valuemap.check.pass_offsets import PassOffset, PassTimeShift
from valuemap.check.pass_turns import PassTurned
from valuemap.check.poses import CameraAxes, CenterAsTranslation, InvertedPoses, PitchAndRoll, QuaternionOrder
from valuemap.check.positions import HeightZero, HeldPositions
from valuemap.check.quality import (
    ClassSpelling,
    EqualScores,
    FarImages,
    QuantisedBoxes,
    RepeatedBoxes,
    RepeatedImages,
    TruthElsewhere,
)
from valuemap.check.repeats import RepeatedDetections
from valuemap.check.rounding import RoundedHeadings, RoundedPositions
from valuemap.check.shifted import ShiftedDetections
from valuemap.check.time_stamps import RollingTimes, TimeUnit
from valuemap.check.wrong_camera import WrongCamera

CONVENTIONS: tuple[Convention, ...] = (
    InvertedPoses(),
    QuaternionOrder(),
    PanoramaMiddle(),  # The same as axes of cameras that are turned about the vertical.
    CameraAxes(),
    CenterAsTranslation(),
    LatLonSwapped(),
    MirroredPositions(),  # On flat ground of the same effect as other axes, and the smaller mistake.
    WorldAxes(),
    HeadingConvention(),
    TiltConvention(),
    DegreesForRadians(),
    PictureSize(),
    MirroredPictures(),
    MirroredWorld(),  # Where cameras do not roll, one is as good as the other.
    ShiftedDetections(),
    CamerasExchanged(),
    InvertedMounts(),
    FocalUnit(),
    PrincipalPoint(),
    HeldPositions(),
    PitchAndRoll(),
    HeadingsUseless(),
)
"""Mistakes that are found by reading the data another way."""

FAULTS: tuple[Fault, ...] = (
    NormalisedBoxes(),
    SidesExchanged(),  # Of other pictures are then only boxes that are outside of both.
    CornersAsCenter(),
    FarImages(),
    RepeatedBoxes(),
    RepeatedImages(),
    CarriedBoxes(),
    RepeatedDetections(),  # What the car carries may be equal, too.
    ClassSpelling(),
    EqualScores(),
    SmallHeightUnit(),
    RoundedPositions(),
    RoundedHeadings(),
    InterpolatedPositions(),
    TopLeftAsCenter(),
    HalfPixel(),
    UpDirection(),
    ConstantHeadings(),
    RotationSigmaUnit(),
    RollingTimes(),
    InterleavedPasses(),
    NoDrives(),
    TimeUnit(),
    HeightUnit(),
    HeightsLeftOut(),
    HeightZero(),
    WrongCamera(),
    CameraMount(),
    PassFrame(),
    PassTurned(),
    PassOffset(),
    PassTimeShift(),
    CameraHeight(),
    LensModel(),
    FocalLength(),
    CameraTilt(),
    CameraYaw(),
    CameraAside(),
    TimeShift(),
    LeverArms(),
    ImpossibleBoxes(),
    TwoNames(),
    HalfSizes(),
    Scale(),
    QuantisedBoxes(),
    MirroredByTruth(),
    TruthElsewhere(),
)
"""All other mistakes; they are looked for stage by stage, in this order in a stage."""
