"""The splats of a run as files, and its state in a checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from ..errors import SceneError
from ..scene.fitted import Fitted
from ..scene.gaussians import Gaussians
from ..scene.ply import write_ply
from ..scene.trainable import Splats
from .density import Density

RESULT = "last.ply"


class ResultFiles:
    """Where a run's splats are written. save: a name to a path under the trial's save/."""

    def __init__(self, save: Callable[[str], Path]):
        self.save = save
        self._kept_at: int | None = None  # the step whose splats are in last.ply, of those that this process trained

    def write(self, name: str, scene: Gaussians, origin: tuple[float, float, float], fitted: Fitted | None) -> Path:
        """Write a 3DGS PLY in the files' world. fitted: at what size the splats were fitted, where that is known."""
        comments = [] if fitted is None else [fitted.comment]
        return write_ply(self.save(name), scene.detach().to("cpu"), origin=origin, comments=comments)

    def keep(self, step: int, write: Callable[[str], Path]) -> Path:
        """Write the result, unless that of `step` is there. write: a name to the PLY of the splats of the moment."""
        path = self.save(RESULT)
        if self._kept_at != step or not path.is_file():
            write(RESULT)
            self._kept_at = step
        return path

    def keep_tested(self, step: int, write: Callable[[str], Path]) -> Path:
        """Write the splats that were scored: the run's result, unless there is one already and a checkpoint, perhaps an
        earlier one, was only looked at again."""
        if self._kept_at is None and self.save(RESULT).is_file():
            return write(f"it{step}-test/point_cloud.ply")
        return self.keep(step, write)


def splats_from(checkpoint: Mapping[str, Any], system: str, density: Density, device: torch.device) -> Splats:
    """The splats of a checkpoint. system: the class that resumes. Raises SceneError for a checkpoint of something
    else, and for one that lacks the state of this density control."""
    lacking = {"splats", "run"} - set(checkpoint)
    if lacking:
        raise SceneError(f"resume: the checkpoint holds no {' and no '.join(lacking)} (found {', '.join(checkpoint)}).")
    maker = checkpoint["run"]["system"]
    if maker != system:
        hint = f"To begin from its splats, give their PLY: system.gs_source=<trial>/save/{RESULT}"
        raise SceneError(f"resume: the checkpoint is of a {maker}, expected one of a {system}. {hint}")
    splats = Splats.from_state_dict(checkpoint["splats"], device)
    missing = [name for name in density.states if name not in splats.state]
    if missing:
        raise SceneError(f"resume: the checkpoint lacks the per-splat state {', '.join(missing)}.")
    return splats
