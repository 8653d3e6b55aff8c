"""What a dataset format is: how a capture is asked for, and what a format says of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from torch import Tensor

from ..config import AtLeastOne, Colour, Count, NonNegative, Range, Side
from ..errors import DataError
from ..registry import Registry
from .lens import Lens
from .sfm.options import SfmOptions
from .truth import GroundTruths, SplatScene

FORMATS = Registry("dataset format", __package__)
FORMATS.add("colmap", ".colmap:FORMAT")
FORMATS.add("demo", "..demo.capture:FORMAT")  # imported when it is asked for: demo/ draws with what stands above it
FORMATS.add("inria", ".inria:FORMAT")
FORMATS.add("nerfstudio", ".transforms:FORMAT")
FORMATS.add("photographs", ".photographs:FORMAT")
FORMATS.add("video", ".video:FORMAT")
AXES = {f"{sign}{axis}": i for sign in ("", "-") for i, axis in enumerate("xyz")}  # what data.orbit_up may name


@dataclass(frozen=True)
class CaptureOptions:
    """How a capture is read; the defaults are those of 3DGS."""

    format: str | None = field(default=None, metadata={"choices": FORMATS})  # None: whichever finds its files
    images: str = "images"  # folder of the photographs in a COLMAP capture
    masks: str = ""  # folder of <photograph>.png, black where a fit leaves its photograph out; empty: those that the
    # capture names itself (nerfstudio's mask_path)
    downscale: Annotated[float, Range("[1, inf)")] = 1.0  # photographs are made smaller by this factor, at least 1
    width: Side | None = None  # pixels; with height: centred crop to their aspect, then resize
    height: Side | None = None  # pixels; width or height alone: the other follows the photograph's aspect
    max_side: Side | None = None  # pixels, longer side at most, where no downscale, width or height is given
    test_every: Count = 8  # every so many views one is held out, from the first on; 0: none
    max_view_num: AtLeastOne | None = None  # views to train on at most, spread evenly over the capture; None: all
    resident_gib: NonNegative = 2.0  # GiB of decoded photographs kept in memory
    background: Colour = (0.0, 0.0, 0.0)  # RGB in [0,1] behind transparent photographs
    dataparser: str = ""  # nerfstudio's dataparser_transforms.json of the splats: cameras are moved into their world
    sfm: SfmOptions = SfmOptions()  # how the cameras of photographs or of a video are found
    orbit_views: Annotated[int, Range("[1, 10000]")] = 48  # views of an orbit around splats that come without cameras
    orbit_up: str = field(default="-y", metadata={"choices": AXES})  # up in them: -y suits COLMAP's, z nerfstudio's

    def __post_init__(self) -> None:
        sized = self.width is not None or self.height is not None
        if self.downscale != 1 and sized:
            raise DataError("data.downscale and data.width or data.height: both set a size; leave one of them out")


class Points(NamedTuple):
    """Points of a reconstruction. xyz [P,3] world units (float64 as a format reads them, float32 in a capture), rgb
    [P,3] in [0,1]."""

    xyz: Tensor
    rgb: Tensor


@dataclass(frozen=True)
class Shot:
    """What a format says of one photograph. viewmat [4,4] float64 world to camera, OpenCV axes; lens as calibrated,
    which may be at another size than the file; path None: there is no photograph. mask: what counts of it, if named."""

    name: str
    viewmat: np.ndarray
    lens: Lens
    path: Path | None
    mask: Path | None = None


@dataclass(frozen=True)
class Scan:
    """What a format reads from its files. notices: sentences for the user about what was left aside.

    scene: splats whose renders are the photographs, where there are no files of any; truths: what edits of the capture
    become, where that is known. found: the folder with report.json and cameras.png of cameras that were found here.
    """

    shots: list[Shot]
    points: Points | None = None
    notices: list[str] = field(default_factory=list)
    scene: SplatScene | None = None
    truths: GroundTruths | None = None
    found: Path | None = None


@dataclass(frozen=True)
class Format:
    """A dataset format: one file that defines one and registers it in FORMATS is enough.

    looks_for: its files, in words. find: the path to read, given a source, or None where the source has none of its
    files. read: what stands at that path; raises DataError. prefix: what a source begins with that is no path; then
    neither `find` nor `read` sees a file, but the source as it was typed.
    """

    looks_for: str
    find: Callable[[Path], Path | None]
    read: Callable[[Path, CaptureOptions], Scan]
    prefix: str = ""


def read_json(path: Path) -> Any:
    """A JSON file's content. Raises DataError where it cannot be read."""
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read as JSON ({error})") from error
