"""Masks given by numbers: a box or a sphere in the world, or a rectangle in one view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from ..config import NonNegative, Number, Positive
from ..data.views import view_number
from ..errors import ConfigError
from .api import MaskRequest, Segmenter

Point = tuple[Number, Number, Number]
Window = tuple[NonNegative, NonNegative, NonNegative, NonNegative]
FORMS = "low and high (a box), center and radius (a sphere), or view and window (a rectangle in one view)"


@dataclass(frozen=True)
class Box(Segmenter):
    """Exactly one of three. Of a box and a sphere: the splats whose centres lie inside.

    Of a rectangle: what is visible in it, no more. A splat's weight is the part of it, as far as that view sees it,
    that lies in the rectangle; what the view does not see, behind the object or beside the picture, is decided by its
    nearest neighbours that it does see. So background that shows between the object and the rectangle's corners is in.
    """

    low: Point | None = None  # corner of a box along the world's axes, world units
    high: Point | None = None  # the opposite corner
    center: Point | None = None  # of a sphere, world units
    radius: Positive | None = None
    view: str | None = None  # name or number of a view
    window: Window | None = None  # left, top, right, bottom, from the upper left corner:
    # pixels of the render, or fractions of its sides where none is over 1

    def __post_init__(self) -> None:
        pairs = (self.low, self.high), (self.center, self.radius), (self.view, self.window)
        given = [pair for pair in pairs if pair != (None, None)]
        if len(given) != 1 or None in given[0]:
            names = [name for name in self.__dataclass_fields__ if getattr(self, name) is not None]
            raise ConfigError(f"got {', '.join(names) or 'nothing'}, expected one of: {FORMS}.")
        if self.low and self.high and not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ConfigError(f"low: {self.low} must lie below high, {self.high}, along each axis.")
        if self.window and not (self.window[0] < self.window[2] and self.window[1] < self.window[3]):
            raise ConfigError(f"window: got {self.window}, expected left < right and top < bottom.")

    def __call__(
        self, request: MaskRequest, views: Sequence[int]
    ) -> dict[int, Float[Tensor, "H W"]] | Float[Tensor, " N"]:
        means = request.scene.means.detach()

        def here(point: tuple[float, float, float]) -> Float[Tensor, " 3"]:
            return means.new_tensor([a - b for a, b in zip(point, request.origin, strict=True)])

        if self.low and self.high:
            return ((means >= here(self.low)) & (means <= here(self.high))).all(dim=1).to(means)
        if self.center and self.radius is not None:
            return ((means - here(self.center)).norm(dim=1) <= self.radius).to(means)
        number = self.number(request)
        return {number: self.rectangle(request.cameras[number].width, request.cameras[number].height)}

    def number(self, request: MaskRequest) -> int:
        """The view that is meant, of all in the capture: by name, or else by number."""
        view = cast(str, self.view)  # there is one where there is no box and no sphere
        return view_number(view, request.names, "system.mask.options.view")

    def rectangle(self, width: int, height: int) -> Float[Tensor, "{height} {width}"]:
        """The window as a mask; a pixel that is cut counts by the part that lies inside."""
        left, top, right, bottom = window = cast(Window, self.window)  # it comes with the view
        if max(window) <= 1:
            left, top, right, bottom = left * width, top * height, right * width, bottom * height
        if left >= width or top >= height:
            raise ConfigError(f"system.mask.options.window: {window} lies outside of the view, {width}x{height}.")
        x, y = torch.arange(width, dtype=torch.float32), torch.arange(height, dtype=torch.float32)
        columns = (torch.minimum(x + 1, x.new_tensor(right)) - torch.maximum(x, x.new_tensor(left))).clamp(0, 1)
        rows = (torch.minimum(y + 1, y.new_tensor(bottom)) - torch.maximum(y, y.new_tensor(top))).clamp(0, 1)
        return rows[:, None] * columns
