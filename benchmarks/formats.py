"""Splat formats: size, time to write and to read, and what is lost. `python benchmarks/formats.py [splats]`: a million
with SH degree 3 by default, a synthetic statue many times over with noise of its own; `--file a.ply` takes splats of
one's own. One thread; beside the seconds that passed, in brackets, those of the processor, which other work on the
machine does not change. PSNR of renders before and after, lowest and highest of the views (of 512 x 512 pixels).
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "custom"))

from dreamcatalyst.data.formats import CaptureOptions  # noqa: E402
from dreamcatalyst.data.orbit import orbit_capture  # noqa: E402
from dreamcatalyst.demo.worlds import make_world  # noqa: E402
from dreamcatalyst.render.api import rasterize  # noqa: E402
from dreamcatalyst.report.metrics import psnr  # noqa: E402
from dreamcatalyst.scene.formats.api import read_splats, write_splats  # noqa: E402
from dreamcatalyst.scene.gaussians import Gaussians  # noqa: E402

FILES = [
    ("ply", {}),
    ("gltf", {}),
    ("compressed-ply", {}),
    ("spz", {"version": 3}),
    ("spz", {"version": 4}),
    ("spz", {"version": 3, "sh1_bits": 8, "sh_bits": 8}),
    ("sog", {}),
    ("splat", {}),
]
SIDE = 512  # pixels


def crowd(n: int) -> Gaussians:
    """`n` splats of the statue's world, each with SH and a place of its own, as a fit scatters them."""
    world, draw = make_world("statue").scene, torch.Generator().manual_seed(0)
    rows = torch.randint(len(world), (n,), generator=draw)
    scene = world[rows]
    share = math.log(len(world) / n) / 2

    def noise(like: torch.Tensor, size: float) -> torch.Tensor:
        return like + size * torch.randn(like.shape, generator=draw)

    return Gaussians(
        means=scene.means + scene.scales * 0.7 * torch.randn(n, 3, generator=draw),
        quats=noise(scene.quats, 0.1),
        log_scales=noise(scene.log_scales + min(share, 0.0), 0.3),
        logit_opacities=noise(scene.logit_opacities - 1, 1.0),
        sh0=noise(scene.sh0, 0.1),
        shN=0.05 * torch.randn(n, 15, 3, generator=draw) * torch.rand(n, 1, 1, generator=draw),
    )


def timed(act: Callable[[], Any]) -> tuple[Any, str]:
    """What comes of it, and the seconds that passed and (the processor's)."""
    wall, own = time.perf_counter(), time.process_time()
    out = act()
    passed = time.perf_counter() - wall
    return out, f"{passed:.2f} ({time.process_time() - own:.2f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("splats", type=int, nargs="?", default=1_000_000)
    parser.add_argument("--file", type=Path, help="splats of one's own")
    parser.add_argument("--views", type=int, default=3)
    args = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    scene = crowd(args.splats) if args.file is None else read_splats(args.file)
    scene = replace(scene, extra={})
    orbit = orbit_capture(scene, CaptureOptions(orbit_views=max(args.views, 1), width=SIDE, height=SIDE, test_every=0))
    cameras = [orbit.cameras([index]) for index in range(args.views)]

    def renders(splats: Gaussians) -> list[torch.Tensor]:
        return [rasterize(splats, camera).rgb.clamp(0, 1) for camera in cameras]

    before = renders(scene)
    print(f"{len(scene):,} splats, SH degree {scene.sh_degree}\n")
    print("| format | MiB | write, s | read, s | PSNR of renders, dB |")
    print("|---|---:|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as folder:
        for name, options in FILES:
            written, write = timed(partial(write_splats, Path(folder) / "a", scene, name, options=options))
            back, read = timed(partial(read_splats, written.path, quiet=True))
            values = [float(psnr(*pair)) for pair in zip(renders(back), before, strict=True)]
            loss = "same" if min(values) == math.inf else f"{min(values):.1f} to {max(values):.1f}"
            told = ", ".join(f"{key}={value}" for key, value in options.items())
            size = written.path.stat().st_size / 2**20
            print(f"| {name}{' ' if told else ''}{told} | {size:.1f} | {write} | {read} | {loss} |", flush=True)
            written.path.unlink()


if __name__ == "__main__":
    main()
