"""What a user says of how cameras are found."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from ...config import PositiveFraction, Range, Seed, Side

PAIRS = ("auto", "exhaustive", "sequential", "retrieval")
CAMERAS = ("auto", "one", "folder", "each")
MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "SIMPLE_RADIAL_FISHEYE", "OPENCV_FISHEYE")


@dataclass(frozen=True)
class SfmOptions:
    """How the cameras of photographs or of a video are found (data.sfm)."""

    photographs: Annotated[int, Range("[3, 10000]")] = 200  # used at most, or frames; more are thinned evenly
    step: Annotated[float, Range("[0.002, 0.5]")] = 0.02  # of a video's diagonal: how far the view moves between frames
    side: Annotated[Side, Range("[128, 32766]")] = 1600  # pixels; features are sought in copies no longer than that
    features: Annotated[int, Range("[256, 65536]")] = 8192  # SIFT features per photograph at most
    # Which photographs are compared: all with all; neighbours in time, and where a walk comes back; those that look
    # alike. auto: all with all up to 60 photographs, then those that look alike; of a video its neighbours in time.
    pairs: str = field(default="auto", metadata={"choices": PAIRS})
    # Who shares intrinsics. auto: photographs of one size, camera and focal length (EXIF), or of one size and folder.
    cameras: str = field(default="auto", metadata={"choices": CAMERAS})
    model: str = field(default="SIMPLE_RADIAL", metadata={"choices": MODELS})  # COLMAP's name of the camera model
    registered: PositiveFraction = 0.5  # share of the photographs that must get a camera; fewer are an error
    seed: Seed = 0
