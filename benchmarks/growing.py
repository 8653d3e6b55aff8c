"""Edits that add what was not there, on the prior that knows the truth: the second table of benchmarks/main_job.py.

For each edit and each kind of mask, at held-out views: `configs/grow.yaml`, the same with the region held to the
outline that it began with, and splats fitted (L1) to the truth itself, for as many steps and with the same mask and
densification.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import torch
from dreamcatalyst.demo.edits import apply_edit, find_edit
from dreamcatalyst.demo.worlds import World, make_world
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.report.metrics import psnr
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians
from dreamcatalyst.scene.ply import read_ply

ROOT = Path(__file__).resolve().parent.parent
INSTRUCTIONS = ("Give the bear a party hat", "Give the bear rabbit ears", "Give the bear a scarf")
FITTED = [
    "system.guidance.rule=known-edit",
    "system.guidance.reduction=mean",
    "system.loss.region=everywhere",
    "system.loss.lambda_outside=0",
    "system.loss.lambda_guidance=10",
]
RUNS = {"edit": [], "outline": ["system.loss.region=start"], "fitted": FITTED}
TEST_EVERY, NEAR = 8, 0.04  # of configs/grow.yaml; world units within which a splat is in the new thing's volume


def statue_box(world: World) -> str:
    """The statue's own bounding box as a mask, not enlarged."""
    rows = slice(*world.thing("bear statue").rows)
    low, high = world.scene.means[rows].amin(0), world.scene.means[rows].amax(0)
    corners = [[round(float(v), 6) for v in corner] for corner in (low - 1e-5, high + 1e-5)]
    return f"system.mask={{kind: box, threshold: 0.1, options: {{low: {corners[0]}, high: {corners[1]}}}}}"


def new_volume(scene: Gaussians, added: Gaussians) -> int:
    """How many splats of `scene` have their centre within NEAR of one of the new thing's."""
    return int((torch.cdist(scene.means, added.means).amin(dim=1) < NEAR).sum())


@torch.no_grad()
def judge(result: Gaussians, world: World, instruction: str) -> dict[str, float]:
    """What the splats of a run are worth, at held-out views.

    inside, unedited: PSNR where the truth shows the new thing, of the result and of the world before. outside: PSNR to
    the source where neither the new thing nor any editable splat, of before or after, has more than a hundredth of a
    pixel. splats, wanted: in the new thing's volume, beyond those of the source; of the truth. depth, depth_before:
    mean error where the new thing is, world units. frozen: 1 where every splat outside of the mask has its bits.
    """
    truth, n = apply_edit(world, find_edit(instruction).name), len(world.scene)
    cameras = world.cameras[list(range(0, len(world.cameras), TEST_EVERY))]
    added = truth.means.new_zeros(len(truth), 1)
    added[n:] = 1
    editable = (result.extra["mask"].reshape(-1, 1) >= 0.1).float()  # the mask's threshold; children inherit
    kept = len(result) - int(editable.sum())
    want = rasterize(truth, cameras, features=added, depth=True)
    got = rasterize(result, cameras, features=editable, depth=True)
    before = rasterize(world.scene, cameras, depth=True)
    frozen = result[editable[:, 0] < 0.5]
    same = matching_rows(frozen, world.scene)
    was_editable = torch.ones(n, 1) if same is None else torch.ones(n, 1).index_fill(0, same, 0.0)
    began = rasterize(world.scene, cameras, features=was_editable)
    where = want.features.round()
    reach = torch.maximum(torch.maximum(want.features, got.features), began.features)
    away = (reach < 0.01).float()

    def mean_psnr(render, reference, weight) -> float:
        values = psnr(render.rgb.clamp(0, 1), reference.rgb.clamp(0, 1), weight)
        return float(values[values.isfinite()].mean())

    def depth_error(render) -> float:
        return float(((render.depth - want.depth).abs() * where).sum() / where.sum())

    return {
        "unedited": mean_psnr(before, want, where),
        "inside": mean_psnr(got, want, where),
        "outside": mean_psnr(got, before, away),
        "splats": new_volume(result, truth[n:]) - new_volume(world.scene, truth[n:]),
        "wanted": len(truth) - n,
        "depth": depth_error(got),
        "depth_before": depth_error(before),
        "editable": n - kept,
        "frozen": float(same is not None),
    }


def matching_rows(frozen: Gaussians, source: Gaussians) -> torch.Tensor | None:
    """The rows of `source` that `frozen` has, in their order and to the bit; None where it is not a part of it."""
    flat = [torch.cat([getattr(s, name).flatten(1) if getattr(s, name).ndim > 1 else getattr(s, name)[:, None]
            for name in PARAMETERS], dim=1) for s in (frozen, source)]  # fmt: skip
    index = {row.numpy().tobytes(): i for i, row in enumerate(flat[1])}
    found = [index.get(row.numpy().tobytes()) for row in flat[0]]
    return None if None in found or found != sorted(found) else torch.tensor(found)


def run(instruction: str, mask: list[str], more: list[str], source: str) -> Gaussians:
    """The splats of one run."""
    with tempfile.TemporaryDirectory() as folder:
        given = [f"data.source={source}", f"system.prompt_processor.prompt={instruction}", f"exp_root_dir={folder}"]
        given += [
            "name=run",
            "tag=grow",
            "use_timestamp=false",
            "system.report.video_frames=0",
            "system.report.every=0",
        ]
        command = [sys.executable, str(ROOT / "launch.py"), "--config", str(ROOT / "configs/grow.yaml")]
        subprocess.run(
            [*command, *given, *mask, *more], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        return read_ply(Path(folder) / "run/grow/save/last.ply")


def measure(results: dict, source: str, keep) -> None:
    """Fill `results` with what is not there yet; `keep` is called after each run."""
    world = make_world(source.removeprefix("demo:"))
    for instruction in INSTRUCTIONS:
        for kind, mask in {"box": [statue_box(world)], "relevance": []}.items():
            row = results.setdefault(f"{instruction}, {kind}", {})
            for name, more in RUNS.items():
                if name not in row:
                    row[name] = judge(run(instruction, mask, more, source), world, instruction)
                    keep()
                    print(f"{instruction}, {kind}, {name}: {row[name]}", file=sys.stderr, flush=True)


def table(results: dict) -> list[str]:
    """The table, as lines of Markdown."""
    out = ["| instruction, mask | unedited | edit | outline | fitted | gain | below it | outside | splats | of truth |"]
    out[0] += " depth error | before | fitted | frozen |"
    out.append("|---" * 14 + "|")
    for name, row in results.items():
        edit, fitted = row["edit"], row["fitted"]
        cells = [f"{edit['unedited']:.1f}", *(f"{row[kind]['inside']:.1f}" for kind in RUNS)]
        cells += [f"{edit['inside'] - edit['unedited']:+.1f}", f"{fitted['inside'] - edit['inside']:.1f}"]
        cells += [f"{edit['outside']:.1f}", f"{edit['splats']:,}", f"{edit['wanted']:,}"]
        cells += [f"{edit['depth']:.2f}", f"{edit['depth_before']:.2f}", f"{fitted['depth']:.2f}"]
        cells += ["same" if all(row[kind]["frozen"] for kind in RUNS) else "CHANGED"]
        out.append(f"| {name} | {' | '.join(cells)} |")
    return out
