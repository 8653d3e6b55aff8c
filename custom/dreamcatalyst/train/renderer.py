"""How a run draws."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import ConfigError


@dataclass(frozen=True)
class RendererConfig:
    """How splats are drawn."""

    backend: str = "auto"  # reference | cpu | gsplat; auto: by the device
    antialiased: bool = False  # Mip-Splatting's 2D filter
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # RGB in [0,1]
    cache_mib: int = 1024  # what is kept of renders of splats that never change; the least recently used goes

    def __post_init__(self) -> None:
        if self.cache_mib < 0:
            raise ConfigError(f"cache_mib: got {self.cache_mib}, expected 0 or more MiB.")
        if not all(0 <= value <= 1 for value in self.background):
            raise ConfigError(f"background: got {self.background}, expected red, green and blue in [0,1].")
