"""The facts of a run that its reports are made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from jaxtyping import Float
from omegaconf import OmegaConf
from torch import Tensor, device

from ..config import AtLeastOne, Count, NonNegative, Range
from ..data.camera import Cameras
from ..data.views import Capture
from ..errors import ConfigError
from ..render.api import Render
from .clip import ClipJudge
from .metrics import compare

Panels = list[tuple[str, Float[Tensor, "H W 3"]]]  # labelled pictures in [0,1], side by side in what is written


@dataclass(frozen=True)
class ReportConfig:
    """What is measured and written beside the result."""

    every: Count = 50  # steps between two rows of report/error.csv; 0: first and last step only
    views: AtLeastOne = 4  # held-out views that each row is measured on
    overhead: NonNegative = 0.025  # rows have their errors measured as long as rows take this share of the time at most
    pictures: Count = 8  # comparisons written at the end
    video_frames: Annotated[int, Range("[0, 100000]")] = 72  # 0: no video
    video_fps: Annotated[int, Range("[1, 1000]")] = 24
    clip: str = ""  # a CLIP (folder, or id on Hugging Face) that scores an edit; empty: none
    clip_source: str = ""  # descriptions of the scene before and after, for CLIP's direction ("a photo of a bear")
    clip_target: str = ""
    aesthetic: str = ""  # the file of LAION's aesthetic predictor, for a CLIP of its width

    def __post_init__(self) -> None:
        for name in ("clip_source", "clip_target", "aesthetic"):
            if getattr(self, name) and not self.clip:
                raise ConfigError(f"{name}: is for a CLIP, and none is given. Name one: report.clip=<folder or id>.")

    def judge(self, device: device) -> ClipJudge | None:
        """CLIP's scores, where they are asked for. Its weights are not read before they are needed."""
        if not self.clip:
            return None
        return ClipJudge(self.clip, self.clip_source, self.clip_target, self.aesthetic, device)


@dataclass(frozen=True)
class RunFacts:
    """A run at one step: what reports may know of it.

    title: what it is about. settings: the system's config. folder: the trial's; save: name to a path under its save/.
    capture, held_out: its views, and the indices of those that are scored. step; splats: how many there are now.
    scenes: the splats of the moment under "", and others by name to compare their consistency with.
    plan: what the run builds, in words; empty before training.
    draw: (scene, cameras, **options of `rasterize`) to a Render. picture: index of a view to its present render
    in [0,1]. references: index to what it is compared with, by name, the aim first. region: index to where a
    view is meant to change, of 0 and 1, or None. panels: index to labelled pictures. frame: a camera to the
    labelled pictures of a moment of the video. judge: CLIP's scores, if any. counts: further numbers for the page, by
    what they count.
    """

    title: str
    config: ReportConfig
    settings: Any
    folder: Path
    save: Callable[[str], Path]
    device: device
    capture: Capture
    held_out: Sequence[int]
    step: int
    splats: int
    plan: str
    scenes: Callable[[], Mapping[str, Any]]
    draw: Callable[..., Render]
    picture: Callable[[int], Float[Tensor, "H W 3"]]
    references: Callable[[int], Mapping[str, Float[Tensor, "H W 3"]]]
    region: Callable[[int], Float[Tensor, "H W 1"] | None]
    panels: Callable[[int], Panels]
    frame: Callable[[Cameras], Panels]
    judge: ClipJudge | None
    counts: Mapping[str, int] = field(default_factory=dict)

    @property
    def report(self) -> Path:
        """The folder of the report."""
        return self.folder / "report"

    @property
    def config_text(self) -> str:
        """What made the run: the whole config where the launcher left it beside the report, else the system's own."""
        whole = self.folder / "configs" / "parsed.yaml"
        return whole.read_text(encoding="utf-8") if whole.is_file() else OmegaConf.to_yaml(self.settings)

    def score(self, index: int, image: Float[Tensor, "H W 3"] | None = None, brief: bool = False) -> dict[str, float]:
        """Metrics of one view against each of its references (`metrics.compare`). image: the picture of the view,
        where it is there already."""
        image = self.picture(index) if image is None else image
        return compare(image, self.references(index), self.region(index), brief)
