"""How a run draws its splats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor, device

from ..config import Colour, Count
from ..data.camera import Cameras
from ..render.api import Backend, Frozen, Render, find_backend, rasterize
from ..report.clock import Clock
from ..scene.gaussians import Gaussians
from ..scene.trainable import Splats


@dataclass(frozen=True)
class RendererConfig:
    """How splats are drawn."""

    backend: str = "auto"  # a name of render.api.BACKENDS; auto: by the device
    antialiased: bool = False  # Mip-Splatting's 2D filter
    background: Colour = (0.0, 0.0, 0.0)  # RGB in [0,1]
    cache_mib: Count = 1024  # what is kept of renders of splats that never change; the least recently used goes

    @property
    def cache_bytes(self) -> int:
        """The same limit."""
        return self.cache_mib * 2**20

    def find(self, device: device) -> Backend:
        """What draws on `device`. Raises ConfigError and SceneError as `find_backend`."""
        return find_backend(self.backend, device)


class Drawer:
    """Renders with the settings of a run, on its clock, and keeps what does not change of frozen splats."""

    def __init__(self, config: RendererConfig, clock: Clock):
        self.config, self.clock = config, clock
        self._frozen: tuple[Gaussians | None, Frozen | None] = None, None

    def __call__(self, scene: Gaussians, cameras: Cameras, background: Tensor | None = None, **options: Any) -> Render:
        """Render V views. background [3]: another one than the run's. options: further ones of `rasterize`."""
        config = self.config
        with self.clock.stage("render"):
            return rasterize(
                scene,
                cameras,
                background=scene.means.new_tensor(config.background) if background is None else background,
                antialiased=config.antialiased,
                backend=config.backend,
                **options,
            )

    def frozen(self, splats: Splats) -> Frozen | None:
        """The splats that never change, with what is kept of their renders."""
        scene = splats.frozen
        if scene is not self._frozen[0]:
            self._frozen = scene, None if scene is None else Frozen(scene, self.config.cache_bytes)
        return self._frozen[1]
