"""What a masked edit saves: time, memory and cache against the area of the mask. `python benchmarks/masked_edit.py`;
about a minute. The verdict comes last; exit status 1 if a floor is missed.

The mask is a square in the middle of the image, the editable splats those whose centre is projected into it. Where a
folder ../shared/bench with `splat_scene.py` lies next to the project, its scene is drawn, else one of the same kind.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from statistics import median

import numba
import torch
from torch import Tensor

sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parent.parent / "custom")]

from dreamcatalyst.data.camera import Cameras  # noqa: E402
from dreamcatalyst.render.api import Frozen  # noqa: E402
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians  # noqa: E402
from dreamcatalyst.scene.generations import Generations  # noqa: E402
from dreamcatalyst.scene.trainable import Splats  # noqa: E402
from rasterize import prepared, timed  # noqa: E402

AREAS = 0.01, 0.02, 0.05, 0.10, 0.20, 0.50, 1.0
FASTER, AREA = 2.5, 0.20  # the floor: forward and backward at this area, against all splats editable
SMALLER, SHARE = 0.1, 0.05  # the ceiling: of a full edit's training memory, at this share of editable splats


def inside(scene: Gaussians, cameras: Cameras, area: float) -> Tensor:
    """bool [N]: the splats whose centre is projected into a middle square of `area` of the image."""
    in_camera = scene.means @ cameras.viewmats[0, :3, :3].T + cameras.viewmats[0, :3, 3]
    pixels = (in_camera @ cameras.Ks[0].T)[:, :2] / in_camera[:, 2:]
    size = pixels.new_tensor([cameras.width, cameras.height])
    return ((pixels - size / 2).abs() <= size / 2 * area**0.5).all(-1)


def training_bytes(scene: Gaussians, editable: Tensor | None) -> int:
    """Bytes of gradients, Adam's moments and anchors, after one step that really makes them."""
    splats = Splats(scene, editable=editable)
    splats.make_optimizer(dict.fromkeys(PARAMETERS, 1e-3))
    generations = Generations(first=1.0, init=1.0, multiplier=2.0, cap=10.0)
    generations.begin(splats)
    sum(value.sum() for value in splats.parameters.values()).backward()
    splats.optimizer.step()
    made = [value.grad for value in splats.parameters.values()] + [splats.state[name] for name in generations.states]
    made += [value for moments in splats.optimizer.state.values() for value in moments.values()]
    return sum(value.untyped_storage().nbytes() for value in made)


def area_table(n: int, side: int, repeats: int) -> dict[float, float]:
    """Print time and memory by area; how many times as fast as the full edit each is."""
    _, full, cameras = prepared(n, side)
    cotangent = torch.randn(1, side, side, 3, generator=torch.Generator().manual_seed(0))
    print(
        f"{n} splats, {side} x {side}, SH degree 0, float32, {numba.get_num_threads()} threads. Medians of {repeats} "
        "runs, each in turn\nwith a run where all splats are editable. Training memory: gradients, Adam, anchors.\n"
        "   area  editable  forward  backward   total ms  full ms  times as fast  cache MiB/view  training MiB"
    )
    ratios = {}
    for area in AREAS:
        scene = full.detach()
        editable = inside(scene, cameras, area)
        part, frozen = scene[editable].clone(), Frozen(scene[~editable])
        for _, parameter in part.parameters():
            parameter.requires_grad_()
        ours, theirs = [], []
        for repeat in range(repeats + 1):
            pair = timed(full, cameras, cotangent), timed(part, cameras, cotangent, frozen=frozen)
            if repeat > 0:  # the first compiles, and fills the cache
                theirs.append(sum(pair[0]))
                ours.append(pair[1])
        forward, backward = (1e3 * median(times[k] for times in ours) for k in (0, 1))
        ratios[area] = median(a / sum(b) for a, b in zip(theirs, ours, strict=True))
        print(
            f"{area:7.0%} {editable.double().mean():9.1%} {forward:8.1f} {backward:9.1f}"
            f" {1e3 * median(map(sum, ours)):10.1f} {1e3 * median(theirs):8.1f} {ratios[area]:14.2f}"
            f" {frozen.kept.bytes / 2**20:15.1f} {training_bytes(scene, editable) / 2**20:13.1f}"
        )
    return ratios


def memory_share(n: int) -> float:
    """Print the training memory of N splats of SH degree 3, all and a part of them editable, and their ratio."""
    zeros = torch.zeros(n, 3)
    scene = Gaussians.from_colors(zeros, zeros + 1, zeros, torch.full((n,), 0.5), sh_degree=3)
    editable = torch.arange(n) < SHARE * n
    part, full = (training_bytes(scene, rows) for rows in (editable, None))
    print(
        f"\n{n} splats of SH degree 3, gradients + Adam + anchors: {full / 2**20:.0f} MiB for all, "
        f"{part / 2**20:.0f} MiB with {SHARE:.0%} editable, {part / full:.4f} of it"
    )
    return part / full


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=15, help="runs at each area, after one that compiles")
    parser.add_argument("--splats", type=int, default=100_000, help="splats of the scene that is timed")
    parser.add_argument("--side", type=int, default=512, help="pixels")
    options = parser.parse_args()
    ratio = area_table(options.splats, options.side, options.repeats)[AREA]
    share = memory_share(1_000_000)
    met = ratio >= FASTER and share <= SMALLER
    print(
        f"\n{'MET' if met else 'MISSED'}: {AREA:.0%} of the image editable is {ratio:.2f} times as fast as all of it "
        f"(floor {FASTER});\n{SHARE:.0%} of the splats editable take {share:.4f} of the memory (ceiling {SMALLER})."
    )
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
