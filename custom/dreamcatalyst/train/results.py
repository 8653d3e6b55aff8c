"""What a run leaves behind: the splats, scores, pictures, a video and its report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch

from .. import plugin
from ..config import AtLeastOne, Count, NonNegative, Range
from ..errors import ConfigError
from ..report.clip import ClipJudge
from ..report.pictures import picture_row, write_png, write_video
from .scores import last_scores, log_scores, mean_scores, print_scores
from .summary import unmeasured, write_report

if TYPE_CHECKING:
    from .system import SplatSystem


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

    def judge(self, device: torch.device) -> ClipJudge | None:
        """CLIP's scores, where they are asked for. Its weights are not read before they are needed."""
        if not self.clip:
            return None
        return ClipJudge(self.clip, self.clip_source, self.clip_target, self.aesthetic, device)


@torch.no_grad()
def write_video_along(system: SplatSystem, path: Path) -> Path | None:
    """A video along a path inside the hull of the training cameras; None where the report asks for none."""
    config, capture = system.part["report"], system.capture
    if not config.video_frames:
        return None
    from ..data.orbit import video_path

    cameras = video_path(capture.training_cameras, config.video_frames)

    def frames() -> Iterator[np.ndarray]:
        for i in range(len(cameras)):
            panels = system.video_frame(cameras[i])
            row = picture_row(panels)
            yield row if any(label for label, _ in panels) else row[-panels[0][1].shape[0] :]

    return write_video(path, frames(), config.video_fps)


def write_all(system: SplatSystem, scores: Mapping[int, Mapping[str, float]]) -> None:
    """Write splats, report, comparisons and video, in the order of what would be missed most; print the scores and
    where things are."""
    step, capture = system.true_global_step, system.capture
    written = [system.keep_tested()]
    more = last_scores(system, list(scores)[: system.part["report"].views])
    scores = {index: {**score, **more.get(index, {})} for index, score in scores.items()}
    written += write_report(system, scores)
    shown = list(scores)[:: max(1, len(scores) // max(system.part["report"].pictures, 1))]
    shown = shown[: system.part["report"].pictures]
    if shown:
        rows = [picture_row(system.panels(i)) for i in shown]
        written.append(write_png(system.save_path(f"it{step}-comparison.png"), np.vstack(rows)))
    video = write_video_along(system, system.save_path(f"it{step}-test.mp4"))
    written += [video] if video else []
    print_scores(scores, capture)
    if notice := unmeasured(mean_scores(list(scores.values()))):
        print(notice, flush=True)
    log_scores(system, scores, "test")
    for path in written:
        print(f"wrote {path}", flush=True)
    plugin.info(f"{system.splats.total} splats after {step} steps, {system.clock.seconds:.1f} s")
