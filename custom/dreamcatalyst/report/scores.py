"""Scores of held-out views: their means, their table, and those that are taken once, at the end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from ..data.views import Capture
from .consistency import disagreement, nearest_views
from .run import RunFacts


def mean_scores(scores: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean over views of every score."""
    names = dict.fromkeys(name for score in scores for name in score)
    return {name: float(np.mean([score[name] for score in scores if name in score])) for name in names}


def score_table(scores: Mapping[int, Mapping[str, float]], capture: Capture) -> str:
    """One line per view and the mean, as text; of an edit that is confined, what says something about it."""
    columns = [c for c in mean_scores(list(scores.values())) if not c.startswith("consistency")]
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


@torch.no_grad()
def last_scores(run: RunFacts, views: Sequence[int]) -> dict[int, dict[str, float]]:
    """Scores that are taken once, at the end: consistency with the view that is nearest ("short") and 7th nearest
    ("long"), of the splats and of the other scenes, and CLIP's."""
    scores: dict[int, dict[str, float]] = {index: {} for index in views}
    capture = run.capture
    everything = capture.poses(range(len(capture)))
    for name, scene in run.scenes().items():
        renders = {}
        for index in views:
            others = nearest_views(everything, index, (1, 7))
            for view in (index, *others):
                if view not in renders:
                    renders[view] = run.draw(scene, capture.cameras([view]), depth=True)
            for reach, other in zip(("short", "long"), others, strict=False):
                pair = renders[index], capture.cameras([index]), renders[other], capture.cameras([other])
                if (value := disagreement(*pair)) is not None:
                    scores[index]["_".join(filter(None, ("consistency", reach, name)))] = value
    if run.judge is not None:
        for index in views:
            source = run.references(index).get("source")
            if source is not None:
                scores[index] |= run.judge(source[None], run.picture(index)[None])[0]
    return scores
