"""How a run draws."""

from __future__ import annotations

from dataclasses import dataclass

from ..config import Colour, Count


@dataclass(frozen=True)
class RendererConfig:
    """How splats are drawn."""

    backend: str = "auto"  # reference | cpu | gsplat; auto: by the device
    antialiased: bool = False  # Mip-Splatting's 2D filter
    background: Colour = (0.0, 0.0, 0.0)  # RGB in [0,1]
    cache_mib: Count = 1024  # what is kept of renders of splats that never change; the least recently used goes
