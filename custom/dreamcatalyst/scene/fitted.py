"""At what size splats were fitted: a comment in their file (the header of a PLY), which other programs pass over."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from ..data.views import View
from .formats.api import read_comments

COMMENT = re.compile(r"fitted at (\d+) x (\d+) pixels, focal length (\d+(?:\.\d+)?)")
TOLERANCE = 1.05  # of the focal length: sizes are rounded to whole pixels


@dataclass(frozen=True)
class Fitted:
    """Width and height of the pictures of a fit, pixels, and the median of their focal lengths, pixels: how finely they
    show things, however they are cropped."""

    width: int
    height: int
    focal: float

    @classmethod
    def at(cls, views: Sequence[View]) -> Fitted:
        """Of these views as they are used. The size is the first one's."""
        cameras = [view.camera for view in views]
        return cls(cameras[0].width, cameras[0].height, median(float(camera.Ks[0, 0, 0]) for camera in cameras))

    @classmethod
    def of(cls, path: str | Path) -> Fitted | None:
        """What the splat file at `path` says; None where it says nothing. Raises SceneError where it is none."""
        found = next(filter(None, map(COMMENT.fullmatch, read_comments(path))), None)
        return None if found is None else cls(int(found[1]), int(found[2]), float(found[3]))

    @property
    def comment(self) -> str:
        """For a splat file."""
        return f"fitted at {self.width} x {self.height} pixels, focal length {self.focal:.1f}"

    def too_coarse_for(self, views: Sequence[View]) -> float | None:
        """How many times as fine as the fit these views show things; None where it is not more than they can: splats
        need not be finer than the photographs are."""
        needed = min(Fitted.at(views).focal, median(map(_finest, views)))
        return needed / self.focal if needed > TOLERANCE * self.focal else None


def downscale_for(views: Sequence[View]) -> float:
    """By how much the photographs of `views` may be made smaller for a fit that is as fine as the views are: 1 or
    more."""
    return max(1.0, median(map(_finest, views)) / Fitted.at(views).focal)


def _finest(view: View) -> float:
    """The focal length of a view's photograph as it was taken, pixels; without one, of the view."""
    enlarged = view.photo.window[2] / view.photo.width if view.photo is not None else 1.0
    return float(view.camera.Ks[0, 0, 0]) * enlarged
