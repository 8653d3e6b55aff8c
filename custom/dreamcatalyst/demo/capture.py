"""Made worlds as a dataset format, `demo:<world>`: a run on one is like a run on photographs whose outcome is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..data.camera import Cameras
from ..data.formats import CaptureOptions, Format, Points, Scan, Shot
from ..data.lens import Lens
from ..data.truth import GroundTruths
from ..scene.gaussians import SH_C0
from .edits import find_edit, possible
from .truth import ground_truth
from .worlds import World, make_world

PREFIX = "demo:"  # a data source that starts with it names a world, not a folder
POINTS = 3000  # points that stand in for those of a reconstruction


def read(source: Path, options: CaptureOptions) -> Scan:
    """The world that `source` names. Raises ConfigError naming the nearest known one."""
    return scan_world(make_world(str(source).removeprefix(PREFIX)))


def scan_world(world: World) -> Scan:
    """The cameras of `world`, its splats for photographs, some of them for points, and what its edits become."""
    scene = world.scene[:: max(1, len(world.scene) // POINTS)]
    points = Points(scene.means, (0.5 + SH_C0 * scene.sh0[:, 0]).clamp(0, 1))
    truths = GroundTruths(
        lambda instruction: ground_truth(world, find_edit(instruction)),
        tuple(edit.phrases[0] for edit in possible(world) if edit.phrases[0]),
    )
    shots = [_shot(i, world.cameras) for i in range(len(world.cameras))]
    return Scan(shots, points, scene=world.scene, truths=truths)


def _shot(index: int, cameras: Cameras) -> Shot:
    K = cameras.Ks[index].double()
    fx, fy, cx, cy = (float(K[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    lens = Lens(fx, fy, cx, cy, cameras.width, cameras.height)
    return Shot(f"{index:04d}", cameras.viewmats[index].double().numpy().astype(np.float64), lens, None)


FORMAT = Format("demo:statue, or demo:random:<seed>", lambda source: source, read, PREFIX)
