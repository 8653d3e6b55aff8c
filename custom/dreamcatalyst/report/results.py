"""What a run leaves behind: the splats, scores, pictures, a video and its report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from ..data.orbit import video_path
from .pictures import picture_row, write_png, write_video
from .record import Record
from .run import RunFacts
from .scores import last_scores, mean_scores, print_scores
from .summary import unmeasured, write_report


@torch.no_grad()
def write_video_along(run: RunFacts, path: Path) -> Path | None:
    """A video along a path inside the hull of the training cameras; None where the report asks for none."""
    if not run.config.video_frames:
        return None
    cameras = video_path(run.capture.training_cameras, run.config.video_frames)

    def frames() -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        for i in range(len(cameras)):
            panels = run.frame(cameras[i])
            row = picture_row(panels)
            yield row if any(label for label, _ in panels) else row[-panels[0][1].shape[0] :]

    return write_video(path, frames(), run.config.video_fps)


def write_results(
    run: RunFacts, record: Record, scores: Mapping[int, Mapping[str, float]], splats: Path
) -> dict[str, float]:
    """Write report, comparisons and video, in the order of what would be missed most; print the scores and where things
    are. splats: the PLY that was written before. Returns the means of the scores."""
    more = last_scores(run, list(scores)[: run.config.views])
    scores = {index: {**score, **more.get(index, {})} for index, score in scores.items()}
    written = [splats, *write_report(run, record, scores)]
    shown = list(scores)[:: max(1, len(scores) // max(run.config.pictures, 1))]
    shown = shown[: run.config.pictures]
    if shown:
        rows = [picture_row(run.panels(i)) for i in shown]
        written.append(write_png(run.save(f"it{run.step}-comparison.png"), np.vstack(rows)))
    video = write_video_along(run, run.save(f"it{run.step}-test.mp4"))
    written += [video] if video else []
    print_scores(scores, run.capture)
    mean = mean_scores(list(scores.values()))
    if notice := unmeasured(mean):
        print(notice, flush=True)
    for path in written:
        print(f"wrote {path}", flush=True)
    return mean
