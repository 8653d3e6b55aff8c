"""What a capture becomes by an edit, where that is known in 3D and so at every view."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from .camera import Cameras


@runtime_checkable
class SplatScene(Protocol):
    """What is asked of splats here (a Gaussians has it): means [N,3] and standard deviations [N,3], world units;
    opacities [N] in (0,1)."""

    @property
    def means(self) -> Tensor: ...
    @property
    def scales(self) -> Tensor: ...
    @property
    def opacities(self) -> Tensor: ...

    def to(self, *where: Any, **how: Any) -> Any:
        """The same splats on another device."""


Draw = Callable[..., Any]  # (scene, cameras, **options of `rasterize`) -> Render


def normalised(instruction: str) -> str:
    """`instruction` without case, punctuation and spare spaces: instructions that agree in it ask for the same."""
    return " ".join(re.findall(r"[^\W_]+", instruction.casefold()))


@dataclass(frozen=True)
class GroundTruth:
    """The outcome of one edit.

    scene: N' splats after it. share [N',1]: 1 for the splats that the edit is about, 0 for the rest; None for an edit
    of everything. before: the splats before it, in the same order; None where nothing of what the edit is about was
    there.
    """

    scene: SplatScene
    share: Tensor | None = None
    before: SplatScene | None = None

    def to(self, device: torch.device | str) -> GroundTruth:
        """The same on another device."""
        changes = {"scene": self.scene.to(device)}
        changes |= {key: value.to(device) for key in ("share", "before") if (value := getattr(self, key)) is not None}
        return replace(self, **changes)

    @torch.no_grad()
    def image(self, draw: Draw, camera: Cameras) -> Tensor:
        """The edited scene at one view, [H,W,3] in [0,1]."""
        return draw(self.scene, camera).rgb[0].clamp(0, 1)

    @torch.no_grad()
    def region(self, draw: Draw, camera: Cameras) -> Tensor | None:
        """Where one view shows what is edited, before or after, [H,W,1] of 0 and 1; None for an edit of everything."""
        if self.share is None:
            return None
        scenes = [self.scene] if self.before is None else [self.before, self.scene]
        shares = [draw(scene, camera, features=self.share).features[0] for scene in scenes]
        return torch.stack(shares).amax(0).round()


@dataclass(frozen=True)
class GroundTruths:
    """The outcomes that a capture knows. find: an instruction, in any wording that it knows, to its outcome; None for
    others. instructions: one wording of each."""

    find: Callable[[str], GroundTruth | None]
    instructions: tuple[str, ...]
