"""The scene before the edit, at the views of a run."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ..cache import ByteCache
from ..data.camera import Cameras
from ..scene.gaussians import Gaussians
from ..scene.trainable import Splats
from .drawing import Drawer
from .region import EditRegion


class SourceViews:
    """Renders of `scene`, each drawn once, and where each may change.

    camera: index of a view to its camera. splats: those that are edited, once there are some. limit: bytes that are
    kept at most. region: where the edit may take place; None everywhere.
    """

    def __init__(
        self,
        scene: Gaussians,
        draw: Drawer,
        camera: Callable[[int], Cameras],
        splats: Callable[[], Splats | None],
        limit: int,
    ):
        self.scene, self.draw, self.camera, self.splats = scene, draw, camera, splats
        self.region: EditRegion | None = None
        self._views = ByteCache(limit)

    def restrict(self, region: EditRegion) -> None:
        """Drawn from here on as the splats of a masked edit are."""
        self.region = region
        self._views.clear()

    @torch.no_grad()
    def view(self, index: int) -> tuple[Tensor, Tensor | None]:
        """The source at one view, [H,W,3], and where it may change, [H,W,1] in [0,1] (None: everywhere).

        As renders of the edit it is not clamped, and it is drawn in the same way: where nothing was edited, the two
        must be equal to the bit.
        """
        return self._views.get(index, lambda: self._draw(self.camera(index)))

    def render(self, index: int) -> Tensor:
        """The source at one view, [H,W,3], not clamped."""
        return self.view(index)[0]

    def _draw(self, camera: Cameras) -> tuple[Tensor, Tensor | None]:
        region = self.region
        if region is None:
            return self.draw(self.scene, camera).rgb[0], None
        start = self.draw(region.scene, camera, features=region.share)
        if not region.is_source:
            return self.draw(self.scene, camera).rgb[0], start.features[0]
        splats = self.splats()
        if splats is None:
            return start.rgb[0], start.features[0]
        return self.draw(region.edited, camera, frozen=self.draw.frozen(splats)).rgb[0], start.features[0]
