"""Time and memory of the CPU rasterizer. `python benchmarks/rasterize.py` prints four tables; about two minutes.

Where a folder ../shared/bench with `splat_scene.py` and `raster_sketch.py` lies next to the project, its scene is
drawn, and its rasterizer (compositing only, without projection and colours) is timed in turn with ours.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import resource
import sys
import time
from pathlib import Path
from statistics import median
from types import ModuleType

import numba
import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "custom"))

from dreamcatalyst.data.camera import Cameras  # noqa: E402
from dreamcatalyst.render.api import Frozen, rasterize  # noqa: E402
from dreamcatalyst.scene.gaussians import Gaussians  # noqa: E402

SIZES = ((20_000, 128), (20_000, 256), (100_000, 256), (100_000, 512))


def shared(name: str) -> ModuleType | None:
    """The module ../shared/bench/<name>.py, None where it is absent."""
    path = ROOT.parent / "shared" / "bench" / f"{name}.py"
    if not path.exists():
        return None
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def cloud(n: int, side: int) -> dict[str, torch.Tensor]:
    """Our own scene of the same kind: N splats in a cube of side 2 at distance 4, smaller the more there are."""
    g = torch.Generator().manual_seed(1)
    means = torch.rand(n, 3, generator=g) * 2 + torch.tensor([-1.0, -1.0, 3.0])
    scales = (0.03 * (20_000 / n) ** (1 / 3)) * torch.randn(n, 3, generator=g).mul(0.4).exp()
    quats = torch.nn.functional.normalize(torch.randn(n, 4, generator=g), dim=-1)
    opacities, colors = torch.sigmoid(torch.randn(n, generator=g) + 1), torch.rand(n, 3, generator=g)
    K = torch.tensor([[1.4 * side, 0, side / 2], [0, 1.4 * side, side / 2], [0, 0, 1]])
    return dict(means=means, scales=scales, quats=quats, opacities=opacities, colors=colors, viewmat=torch.eye(4), K=K)


def prepared(n: int, side: int, sh_degree: int = 0) -> tuple[dict, Gaussians, Cameras]:
    """The scene as plain tensors, as splats that take derivatives, and its camera."""
    bench = shared("splat_scene")
    scene = bench.splat_scene(n, side, side) if bench else cloud(n, side)
    plain = (scene[name] for name in ("means", "scales", "colors", "opacities", "quats"))
    splats = Gaussians.from_colors(*plain, sh_degree).clone()
    for _, parameter in splats.parameters():
        parameter.requires_grad_()
    return scene, splats, Cameras(scene["viewmat"][None], scene["K"][None], side, side)


def timed(
    splats: Gaussians, cameras: Cameras, cotangent: torch.Tensor, backend: str = "cpu", frozen: Frozen | None = None
) -> tuple[float, float]:
    """Seconds of one forward and one backward pass: projection, colours, compositing."""
    for _, parameter in splats.parameters():
        parameter.grad = None
    start = time.perf_counter()
    image = rasterize(splats, cameras, backend=backend, frozen=frozen).rgb
    middle = time.perf_counter()
    image.backward(cotangent)
    return middle - start, time.perf_counter() - middle


def intersections(splats: Gaussians, cameras: Cameras) -> tuple[int, float]:
    """Pairs of splat and tile of one view, and MiB that the graph holds and the backward pass takes for them."""
    rgb = rasterize(splats, cameras, backend="cpu").rgb
    _, order, first_slots, drawn = rgb.grad_fn.lists[0]
    slots = int(first_slots[-1])
    held = sum(a.nbytes for a in (order, first_slots, *drawn) if isinstance(a, np.ndarray))
    return slots, (held + slots * (9 * 4 + 1)) / 2**20


def anchor(repeats: int) -> None:
    """Our times at the four sizes, in turn with the sketch's."""
    sketch = shared("raster_sketch")
    print(f"\nForward and backward of one view, SH degree 0, float32, {numba.get_num_threads()} threads; milliseconds")
    if sketch is None:
        print("(../shared/bench is absent: our own scene, and no sketch to compare with)")
    print("splats   side  forward backward  total(min) total(median)  sketch(min) (median)  ratio(min) (median)"
          "     pairs  MiB")  # fmt: skip
    for n, side in SIZES:
        scene, splats, cameras = prepared(n, side)
        cotangent = np.random.default_rng(0).standard_normal((side, side, 3)).astype(np.float32)
        ours, theirs = [], []
        inputs = sketch.projected(scene, side, side) if sketch else None
        for repeat in range(repeats + 1):
            pair = timed(splats, cameras, torch.from_numpy(cotangent)[None])
            other = sketch.run(*inputs, side, side, cotangent)[2] if sketch else math.nan
            if repeat > 0:  # the first compiles
                ours.append(pair)
                theirs.append(other)
        total = [sum(pair) for pair in ours]
        forward, backward = (1e3 * median(pair[k] for pair in ours) for k in (0, 1))
        pairs, mib = intersections(splats, cameras)
        print(
            f"{n:6d} {side:6d} {forward:8.1f} {backward:8.1f} {1e3 * min(total):11.1f} {1e3 * median(total):13.1f}"
            f" {1e3 * min(theirs):12.1f} {1e3 * median(theirs):8.1f} {min(theirs) / min(total):11.2f}"
            f" {median(theirs) / median(total):8.2f} {pairs:9d} {mib:4.0f}"
        )


def against_reference(repeats: int) -> None:
    """The ratio to the dense reference."""
    _, splats, cameras = prepared(2000, 64)
    cotangent = torch.randn(1, 64, 64, 3, generator=torch.Generator().manual_seed(0))
    best = {}
    for backend in ("cpu", "reference"):
        best[backend] = min(sum(timed(splats, cameras, cotangent, backend)) for _ in range(repeats))
    ratio = best["reference"] / best["cpu"]
    print(
        f"\n2000 splats, 64x64, float32: cpu {best['cpu'] * 1e3:.1f} ms, reference {best['reference'] * 1e3:.0f} ms, "
        f"ratio {ratio:.0f}"
    )


def growth(repeats: int) -> None:
    """How time grows with splats and with pixels: the slope of log time over log size, fitted by least squares."""
    for what, sizes in (
        ("splats, 256x256", [(n, 256) for n in (5_000, 20_000, 80_000, 320_000)]),
        ("pixels, 50000 splats", [(50_000, side) for side in (64, 128, 256, 512, 1024)]),
    ):
        print(f"\nGrowth with {what} (milliseconds, smallest of {repeats}; splats shrink as they grow in number)")
        logs = []
        for n, side in sizes:
            _, splats, cameras = prepared(n, side)
            cotangent = torch.randn(1, side, side, 3, generator=torch.Generator().manual_seed(0))
            best = min(sum(timed(splats, cameras, cotangent)) for _ in range(repeats))
            logs.append((math.log(n if what.startswith("splats") else side * side), math.log(best)))
            print(f"{n:7d} splats {side:5d}x{side:<5d} {best * 1e3:8.1f}")
        print(f"exponent {np.polyfit(*zip(*logs, strict=True), 1)[0]:.2f}")


def harmonics(repeats: int) -> None:
    """What higher SH degrees cost at (100k, 256^2)."""
    print("\n100000 splats, 256x256 by SH degree (milliseconds)")
    for degree in range(4):
        _, splats, cameras = prepared(100_000, 256, degree)
        cotangent = torch.randn(1, 256, 256, 3, generator=torch.Generator().manual_seed(0))
        print(f"degree {degree}: {1e3 * min(sum(timed(splats, cameras, cotangent)) for _ in range(repeats)):.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=10, help="runs at each size, after one that compiles")
    repeats = parser.parse_args().repeats
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    anchor(repeats)
    growth(min(repeats, 4))
    harmonics(min(repeats, 4))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"\nPeak resident memory rose by {(peak - before) / 1024:.0f} MiB over all of these.")
    against_reference(min(repeats, 3))


if __name__ == "__main__":
    main()
