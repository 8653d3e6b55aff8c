"""What a run leaves behind: scores, pictures, a video, the error curve and the splats."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from .. import plugin
from ..data.views import Capture
from ..errors import ConfigError
from ..report.pictures import picture_row, write_png, write_video

if TYPE_CHECKING:
    from .system import SplatSystem


@dataclass(frozen=True)
class ReportConfig:
    """What is measured and written beside the result."""

    every: int = 50  # steps between two rows of the error curve; 0: first and last step only
    views: int = 4  # held-out views that each row is measured on
    pictures: int = 8  # comparisons written at the end
    video_frames: int = 72  # 0: no video
    video_fps: int = 24

    def __post_init__(self) -> None:
        for name, least in dict(every=0, views=1, pictures=0, video_frames=0, video_fps=1).items():
            if getattr(self, name) < least:
                raise ConfigError(f"{name}: got {getattr(self, name)}, expected {least} or more.")


def mean_scores(scores: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean over views of every score."""
    names = dict.fromkeys(name for score in scores for name in score)
    return {name: float(np.mean([score[name] for score in scores if name in score])) for name in names}


def score_table(scores: Mapping[int, Mapping[str, float]], capture: Capture) -> str:
    """One line per view and the mean, as text; of an edit that is confined, what says something about it."""
    columns = list(mean_scores(list(scores.values())))
    if any(c.endswith("_outside") for c in columns):
        columns = [c for c in columns if c.endswith(("_inside", "_outside")) and not c.startswith("l1")]
    if not columns:
        return "no scores: there is nothing to compare with"
    width = max(8, *(len(capture.views[i].name) for i in scores))
    widths = [max(9, len(c)) for c in columns]
    lines = [" ".join([" " * width, *(f"{c:>{w}}" for c, w in zip(columns, widths, strict=True))])]
    rows = {capture.views[i].name: score for i, score in scores.items()} | {"mean": mean_scores(list(scores.values()))}
    for name, score in rows.items():
        values = (f"{score[c]:>{w}.3f}" if c in score else f"{'-':>{w}}" for c, w in zip(columns, widths, strict=True))
        lines.append(" ".join([f"{name:<{width}}", *values]))
    return "\n".join(lines)


def print_scores(scores: Mapping[int, Mapping[str, float]], capture: Capture) -> None:
    """Show the table of held-out views to the user."""
    print(f"held-out views ({len(scores)}):\n{score_table(scores, capture)}", flush=True)


def log_scores(system: SplatSystem, scores: Mapping[int, Mapping[str, float]], stage: str) -> None:
    """Hand the mean scores to Lightning's loggers."""
    system.log_dict({f"{stage}/{name}": value for name, value in mean_scores(list(scores.values())).items()})


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


def write_report(system: SplatSystem, scores: Mapping[int, Mapping[str, float]]) -> list[Path]:
    """Write the summary and, where there was training, the error curve; return their folder."""
    folder = system.report_dir
    folder.mkdir(parents=True, exist_ok=True)
    mean = mean_scores(list(scores.values()))
    summary = {
        "step": system.true_global_step,
        "seconds": round(system.seconds, 2),
        "splats": system.splats.total,
        "held_out": [system.capture.views[i].name for i in scores],
        "mean": {name: value if math.isfinite(value) else None for name, value in mean.items()},  # JSON has no infinity
    }
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    if system.curve.rows:
        system.curve.write_csv(folder / "error.csv")
        groups = {}
        for metric, unit in (("psnr", "PSNR, dB"), ("ssim", "SSIM")):
            columns = [c for c in system.curve.columns if c.startswith(f"{metric}_")]
            groups |= {f"{unit}, held-out views": columns} if columns else {}
        if groups:
            system.curve.plot(folder / "error.png", groups)
    return [folder]


def write_all(system: SplatSystem, scores: Mapping[int, Mapping[str, float]]) -> None:
    """Write splats, error curve, summary, comparisons and video, in the order of what would be missed most; print the
    scores and where things are."""
    step, capture = system.true_global_step, system.capture
    written = [system.write_splats("last.ply"), *write_report(system, scores)]
    shown = list(scores)[:: max(1, len(scores) // max(system.part["report"].pictures, 1))]
    shown = shown[: system.part["report"].pictures]
    if shown:
        rows = [picture_row(system.panels(i)) for i in shown]
        written.append(write_png(system.save_path(f"it{step}-comparison.png"), np.vstack(rows)))
    video = write_video_along(system, system.save_path(f"it{step}-test.mp4"))
    written += [video] if video else []
    print_scores(scores, capture)
    log_scores(system, scores, "test")
    for path in written:
        print(f"wrote {path}", flush=True)
    plugin.info(f"{system.splats.total} splats after {step} steps, {system.seconds:.1f} s")
