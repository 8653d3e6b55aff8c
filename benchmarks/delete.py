"""Deletions against their truth: a thing of a synthetic scene is taken out of splats that were fitted to renders of it.

Splats are fitted by configs/fit.yaml (kept in --folder, and fitted once); the thing is named by a box or by pictures,
never by its rows; what comes is compared with renders of the world without it, at held-out views. The hole is what no
training view of the world shows: pixels whose point in the world without the thing is hidden in all of them. Views that
the fit itself gets wrong (under 25 dB before anything is taken away) are counted, and left out of the means.

python benchmarks/delete.py [--worlds statue ...] [--inpaint fsr ...] [--steps 1500] [--folder outputs/deletions]
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "custom"), str(ROOT)]

from dreamcatalyst.data.camera import Cameras  # noqa: E402
from dreamcatalyst.data.formats import CaptureOptions  # noqa: E402
from dreamcatalyst.data.loader import open_capture  # noqa: E402
from dreamcatalyst.data.views import Capture  # noqa: E402
from dreamcatalyst.demo.capture import POINTS  # noqa: E402
from dreamcatalyst.demo.edits import apply_edit  # noqa: E402
from dreamcatalyst.demo.worlds import World, make_world  # noqa: E402
from dreamcatalyst.render.api import Render, rasterize  # noqa: E402
from dreamcatalyst.render.lift import lift  # noqa: E402
from dreamcatalyst.render.surface import seen, surface_normals, surface_points  # noqa: E402
from dreamcatalyst.report.metrics import psnr  # noqa: E402
from dreamcatalyst.report.pictures import picture_row, write_png  # noqa: E402
from dreamcatalyst.scene.create import from_points  # noqa: E402
from dreamcatalyst.scene.gaussians import PARAMETERS, SH_C0, Gaussians  # noqa: E402
from dreamcatalyst.scene.mask import distances_to  # noqa: E402
from dreamcatalyst.scene.ply import read_ply, write_ply  # noqa: E402
from dreamcatalyst.train.healing import HealConfig, opened, widened  # noqa: E402

import launch  # noqa: E402

GOOD = 25.0  # dB of the fit itself, below which a view says nothing of a deletion
SHOWN = 2.0  # pixels of a splat that training views see in all, from which on it gives a point
RING = 0.05  # of the longer side: width of the ring around the hole
CASES = {  # world: thing, and how it is named
    "statue": ("bear statue", "box"),
    "random:1": ("bear statue", "files"),
    "random:3": ("ball", "box"),
    "random:6": ("box", "files"),
}


@dataclass(frozen=True)
class Scores:
    """Of one deletion, means over views. bare: without healing. Depths in world units."""

    views: int
    left_out: int
    pixels: float
    bare: float
    healed: float
    ring: float
    thing_bare: float
    thing: float
    depth_bare: float
    depth: float
    same: bool
    counts: tuple[int, ...]
    seconds: float

    def row(self, name: str) -> str:
        """Of a table."""
        gained, same = f"{self.healed - self.bare:+.1f}", "same" if self.same else "CHANGED"
        taken, unseen, added, _ = self.counts
        cells = [name, f"{self.views} of {self.views + self.left_out}", f"{self.pixels:.0f}", f"{self.bare:.1f}"]
        cells += [f"{self.healed:.1f}", gained, f"{self.ring:.1f}", f"{self.thing_bare:.1f}", f"{self.thing:.1f}"]
        cells += [f"{self.depth_bare:.3f}", f"{self.depth:.3f}", same, f"{taken:,} + {unseen:,}", f"{added:,}"]
        return f"| {' | '.join([*cells, f'{self.seconds:.0f}'])} |"


HEAD = (
    "| thing, mask, inpainter | views | hole, px | bare | healed | gain | ring | thing, bare | thing, healed | "
    "depth error, bare | healed | rest | taken | put in | s |\n|---|" + "---:|" * 14
)


def fitted(world: str, folder: Path, steps: int) -> Path:
    """Splats of a synthetic scene, by configs/fit.yaml; those of an earlier run where they are there.

    A synthetic scene's points are its own, also where no view sees them, and a fit would begin with what is under the
    thing. So it begins with those that are seen, as a reconstruction would.
    """
    tag = f"{world.replace(':', '-')}-{steps}"
    path = folder / "fit" / tag / "save" / "last.ply"
    if not path.is_file():
        scene, capture = make_world(world).scene, open_capture(f"demo:{world}", CaptureOptions(max_side=256))
        cameras = capture.cameras(capture.train)
        shown = lift(scene, cameras, torch.ones(len(cameras), cameras.height, cameras.width)).total > SHOWN
        points = scene[shown][:: max(1, int(shown.sum()) // POINTS)]
        first = folder / f"{tag}.ply"
        write_ply(first, from_points(points.means, (0.5 + SH_C0 * points.sh0[:, 0]).clamp(0, 1)))
        run("fit", folder, tag, f"data.source=demo:{world}", f"trainer.max_steps={steps}", f"system.gs_source={first}")
    return path


def run(config: str, folder: Path, tag: str, *options: str) -> None:
    """One run of configs/<config>.yaml. Raises RuntimeError where it fails."""
    base = [f"exp_root_dir={folder}", f"tag={tag}", "use_timestamp=false", "system.report.video_frames=0"]
    status = launch.main(["--config", str(ROOT / f"configs/{config}.yaml"), *base, *options])
    if status:
        raise RuntimeError(f"{config} {tag}: exit status {status}")


def mask_options(world: World, capture: Capture, thing: str, kind: str, folder: Path) -> str:
    """A box somewhat larger than the thing but over the ground, or pictures of it from the training views."""
    first, last = world.thing(thing).rows
    means = world.scene.means[first:last]
    if kind == "box":
        low, high = means.amin(0) - 0.03, means.amax(0) + 0.04
        low[2] = max(float(means[:, 2].amin()) + 0.01, -0.1)
        corners = [f"{name}: {[round(x, 3) for x in at.tolist()]}" for name, at in (("low", low), ("high", high))]
        return f"{{kind: box, options: {{{', '.join(corners)}}}}}"
    share = torch.zeros(len(world.scene), 1)
    share[first:last] = 1
    folder.mkdir(parents=True, exist_ok=True)
    for view in capture.train:
        drawn = rasterize(world.scene, capture.cameras([view]), features=share).features[0].round()
        write_png(folder / f"{capture.views[view].name}.png", (255 * drawn.expand(-1, -1, 3)).numpy().astype(np.uint8))
    return f"{{kind: files, options: {{folder: '{folder}'}}}}"


class Truth:
    """What is known of one world: how it looks without the thing, and where its hole is at each view."""

    def __init__(self, world: World, capture: Capture, thing: str):
        self.world, self.capture = world, capture
        self.after = apply_edit(world, f"no {thing}")
        first, last = world.thing(thing).rows
        self.thing = torch.zeros(len(world.scene), 1)
        self.thing[first:last] = 1
        self.means = world.scene.means[first:last]
        cameras = map(self.camera, capture.train)
        self.shown = [(camera, self.draw(world.scene, camera).depth[0, ..., 0]) for camera in cameras]

    def camera(self, view: int) -> Cameras:
        return self.capture.cameras([view])

    @staticmethod
    def draw(scene: Gaussians, camera: Cameras) -> Render:
        return rasterize(scene, camera, depth=True)

    def outline(self, view: int) -> torch.Tensor:
        """Where a view shows the thing, bool [H,W]."""
        return rasterize(self.world.scene, self.camera(view), features=self.thing).features[0, ..., 0] > 0.5

    def hole(self, view: int) -> torch.Tensor:
        """Where one view shows what no training view had shown, bool [H,W]."""
        camera, outline, config = self.camera(view), self.outline(view), HealConfig()
        depth = self.draw(self.after, camera).depth[0, ..., 0]
        points = surface_points(camera, depth)
        normals, there = surface_normals(camera, points)[outline], points[outline]
        slack = config.tolerance * depth[outline] + config.slack * distances_to(self.means, there)
        hole = torch.zeros_like(outline)
        hole[outline] = ~seen(there, normals, self.shown, slack)
        return opened(hole)


def compared(truth: Truth, view: int, bare: Gaussians, healed: Gaussians) -> list[float]:
    """Numbers of one held-out view with a hole, in the order of Scores."""
    camera, hole, outline = truth.camera(view), truth.hole(view), truth.outline(view)
    ring = widened(hole, round(RING * max(hole.shape))) & ~hole
    after, one, two = (truth.draw(scene, camera) for scene in (truth.after, bare, healed))

    def within(drawn: Render, where: torch.Tensor) -> float:
        return float(psnr(drawn.rgb.clamp(0, 1), after.rgb.clamp(0, 1), where[None, ..., None].float()))

    def off(drawn: Render) -> float:
        return float((drawn.depth - after.depth)[0, ..., 0][hole].abs().mean())

    numbers = [float(hole.sum()), within(one, hole), within(two, hole), within(two, ring)]
    return [*numbers, within(one, outline), within(two, outline), off(one), off(two)]


def fit_error(truth: Truth, view: int, source: Gaussians) -> float:
    """PSNR of the fit before anything was taken away."""
    first, second = (truth.draw(scene, truth.camera(view)).rgb.clamp(0, 1) for scene in (source, truth.world.scene))
    return float(psnr(first, second))


def deletion(name: str, inpaint: str, folder: Path, steps: int) -> tuple[Scores, np.ndarray]:
    """One case, and its pictures from four sides: before, without the thing, healed, truth."""
    thing, kind = CASES[name]
    world, capture = make_world(name), open_capture(f"demo:{name}", CaptureOptions(max_side=256))
    splats, tag = fitted(name, folder, steps), f"{name.replace(':', '-')}-{inpaint}"
    mask = mask_options(world, capture, thing, kind, folder / "masks" / name.replace(":", "-"))
    shutil.rmtree(folder / "delete" / tag, ignore_errors=True)
    began = time.perf_counter()
    given = [f"data.source=demo:{name}", f"system.gs_source={splats}", f"system.thing={thing}"]
    run("delete", folder, tag, *given, f"system.mask={mask}", f"system.inpaint.kind={inpaint}")
    seconds, trial = time.perf_counter() - began, folder / "delete" / tag
    source, healed = read_ply(trial / "save" / "source.ply"), read_ply(trial / "save" / "last.ply")
    state = torch.load(trial / "ckpts" / "last.ckpt", weights_only=False)["deletion"]
    bare, counts = source[~state["thing"]], tuple(state["counts"].values())
    truth = Truth(world, capture, thing)
    holed = [view for view in capture.test if bool(truth.hole(view).any())]
    good = [view for view in holed if fit_error(truth, view, source) >= GOOD]
    rows = [compared(truth, view, bare, healed) for view in good]
    kept = len(healed) - counts[2] - counts[3]
    means, same = np.mean(rows, axis=0), unchanged(bare, healed[:kept])
    scores = Scores(len(good), len(holed) - len(good), *means, same, counts, seconds)
    pictures = []
    for view in capture.test[:4]:
        scenes = {"fitted splats": source, "thing removed": bare, "healed": healed, "truth": truth.after}
        pictures.append(picture_row([(n, truth.draw(s, truth.camera(view)).rgb[0]) for n, s in scenes.items()]))
    return scores, np.vstack(pictures)


def unchanged(before: Gaussians, after: Gaussians) -> bool:
    """Whether `after` are splats of `before`, in their order, every parameter to the bit."""
    place = {tuple(mean): row for row, mean in enumerate(before.means.tolist())}
    rows = [place.get(tuple(mean), -1) for mean in after.means.tolist()]
    if -1 in rows or rows != sorted(rows):
        return False
    return all(torch.equal(getattr(before, name)[rows], getattr(after, name)) for name in PARAMETERS)


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", default=list(CASES), choices=list(CASES), metavar="WORLD")
    parser.add_argument("--inpaint", nargs="+", default=["fsr"], metavar="KIND")
    parser.add_argument("--steps", type=int, default=1500, help="of the fits")
    parser.add_argument("--folder", type=Path, default=Path("outputs/deletions"))
    args = parser.parse_args(argv)
    lines = []
    for world in args.worlds:
        for inpaint in args.inpaint:
            scores, pictures = deletion(world, inpaint, args.folder.resolve(), args.steps)
            write_png(args.folder / f"{world.replace(':', '-')}-{inpaint}.png", pictures)
            lines.append(scores.row(f"{CASES[world][0]} of {world}, {CASES[world][1]}, {inpaint}"))
    print("\n".join([HEAD, *lines]))


if __name__ == "__main__":
    main()
