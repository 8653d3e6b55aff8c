"""Things of other seeds' worlds put into synthetic scenes, against the truth of them lit by these worlds' light.

For each pair and each hour of the day: the thing is stood on the ground under a pixel of one view and its light
matched (system.add.light: off, gain, shading; and the mean colour of the surroundings, "grey world", for comparison).
PSNR where the truth shows the thing, at held-out views; the gap between its lowest splat and the ground, as a part of
its height; whether every splat that was there has its bits. A minute or two; the exit status is 1 where the mean gain
of an hour, a gap or a bit is not as it should be.

python benchmarks/add.py [--pictures add.png]
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean

import numpy as np
import torch

sys.path[:0] = [str(Path(__file__).resolve().parent.parent / "custom")]

from dreamcatalyst.data.formats import CaptureOptions  # noqa: E402
from dreamcatalyst.data.loader import open_capture  # noqa: E402
from dreamcatalyst.data.views import Capture  # noqa: E402
from dreamcatalyst.demo.edits import apply_edit  # noqa: E402
from dreamcatalyst.demo.things import first_thing, relit  # noqa: E402
from dreamcatalyst.demo.worlds import World, make_world  # noqa: E402
from dreamcatalyst.render.api import rasterize  # noqa: E402
from dreamcatalyst.report.metrics import psnr  # noqa: E402
from dreamcatalyst.report.pictures import picture_row, write_png  # noqa: E402
from dreamcatalyst.scene import light  # noqa: E402
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians  # noqa: E402
from dreamcatalyst.scene.place import ADDED, joined, moved  # noqa: E402
from dreamcatalyst.train.add_config import AddConfig  # noqa: E402
from dreamcatalyst.train.placing import Adder, read_thing  # noqa: E402

PAIRS = (  # host, thing
    ("statue", "random:1"),
    ("statue", "random:17"),
    ("random:1", "random:11"),
    ("random:2", "random:3"),
    ("random:4", "random:21"),
    ("random:5", "random:1"),
    ("random:7", "random:17"),
    ("random:9", "random:11"),
)
HOURS = ("day", "sunset", "night")
KINDS = ("off", "grey world", "gain", "shading")
TEST_EVERY, HEIGHT, AWAY = 8, 0.5, 0.95  # held-out views; of the thing, and its distance from the middle, world units
LEVEL = -0.12  # of all made grounds
GAIN, CONTACT = 2.0, 0.01  # what is asked for: dB of shading over off, and part of the height


@dataclass(frozen=True)
class Place:
    """Where a thing is to stand. view: its number; pixel: of it."""

    view: int
    pixel: tuple[float, float]


def free_place(world: World, capture: Capture) -> Place:
    """A spot of the ground, away from the things that stand there, in that view of it that is most from its side."""
    others = [world.scene.means[slice(*thing.rows)].mean(dim=0) for thing in world.things]
    angles = [2 * math.pi * k / 24 for k in range(24)]
    spots = [torch.tensor([AWAY * math.cos(a), AWAY * math.sin(a), LEVEL]) for a in angles]
    spot = max(spots, key=lambda s: min(float((s - other)[:2].norm()) for other in others))
    cameras = capture.cameras()
    inside = (cameras.viewmats[:, :3, :3] @ spot + cameras.viewmats[:, :3, 3]).unsqueeze(-1)
    pixels = (cameras.Ks @ inside)[:, :2, 0] / inside[:, 2]
    size = pixels.new_tensor([cameras.width, cameras.height])
    shown = ((pixels > 0.03 * size) & (pixels < 0.97 * size)).all(dim=1)
    nearness = torch.nn.functional.cosine_similarity(cameras.centers[:, :2], spot[None, :2])
    view = int(torch.where(shown, nearness, -2.0).argmax())
    return Place(view, (float(pixels[view, 0]), float(pixels[view, 1])))


def at_hour(world: World, scene: Gaussians, hour: str) -> Gaussians:
    """A scene of `world`, perhaps with a thing more, as it is at that hour."""
    return scene if hour == "day" else apply_edit(replace(world, scene=scene), hour)


def grey_world(adder: Adder, scene: Gaussians, there: Gaussians) -> Gaussians:
    """The thing with the mean colour of what is around it."""
    near = (scene.means - there.means.mean(dim=0)).norm(dim=1) <= adder.capture.extent
    factors = light.plain_colors(scene[near]).mean(dim=0) / light.plain_colors(there).mean(dim=0)
    return light.relit(there, factors.expand(len(there), 3))


@torch.no_grad()
def measure(host: str, thing: str, pictures: list[np.ndarray]) -> list[dict]:
    """One row for each hour."""
    world, other = make_world(host), make_world(thing)
    capture, rows = open_capture(f"demo:{host}", CaptureOptions(test_every=TEST_EVERY)), []
    place = free_place(world, capture)
    for hour in HOURS:
        scene, results, added = at_hour(world, world.scene, hour), {}, None
        for kind in ("off", "gain", "shading"):
            where = {"view": str(place.view), "pixel": place.pixel, "height": HEIGHT, "light": kind}
            config = AddConfig(path=f"demo:{thing}", **where)
            adder = Adder(config, read_thing(config, "-y", 0, False, None), capture, rasterize, (0.0, 0.0, 0.0))
            added = adder(scene, None)
            results[kind] = added.scene
            if kind == "off":
                there = moved(first_thing(other), adder.place(scene))
                results["grey world"] = joined(scene, grey_world(adder, scene, there))
        ideal = relit(first_thing(other), other.light, there, world.light)
        truth = at_hour(world, joined(world.scene, ideal), hour)
        lowest = float(there.means[:, 2].min())
        own = results["off"].extra[ADDED] < 0.5
        rows.append(
            {
                "pair": f"{thing} in {host}",
                "hour": hour,
                "gap": abs(lowest - LEVEL) / HEIGHT,
                "same": all(same_bits(scene, result[own]) for result in results.values()),
                **on_the_thing(results, truth, capture),
            }
        )
        if (host, thing) in PAIRS[1:2]:
            pictures.append(sides(results, truth, capture, hour))
    return rows


def same_bits(scene: Gaussians, kept: Gaussians) -> bool:
    return all(torch.equal(getattr(scene, name), getattr(kept, name)) for name in PARAMETERS)


def on_the_thing(results: dict[str, Gaussians], truth: Gaussians, capture: Capture) -> dict[str, float]:
    """Mean PSNR where the truth shows the thing, by kind, over held-out views that show it."""
    cameras = capture.cameras(capture.test)
    share = results["off"].extra[ADDED][:, None]
    want = rasterize(truth, cameras, features=share)
    where = want.features.round()
    seen = where.mean(dim=(1, 2, 3)) > 0.002
    scores = {}
    for kind, scene in results.items():
        values = psnr(rasterize(scene, cameras).rgb.clamp(0, 1), want.rgb.clamp(0, 1), where)
        scores[kind] = float(values[seen].mean())
    return scores


def sides(results: dict[str, Gaussians], truth: Gaussians, capture: Capture, hour: str) -> np.ndarray:
    """The thing from four sides: as it was lit at home, matched, and the truth."""
    numbers = [round(k * len(capture) / 4) for k in range(4)]
    shown = {"as it was": results["off"], "matched": results["shading"], "the truth": truth}
    rows = []
    for number in numbers:
        camera = capture.cameras([number]).resized(256, 256)
        rows.append(
            picture_row([(f"{name}, {hour}", rasterize(scene, camera).rgb[0]) for name, scene in shown.items()])
        )
    return np.vstack(rows)


def table(rows: Sequence[dict]) -> list[str]:
    """As lines of Markdown."""
    out = [f"| thing and world | hour | {' | '.join(KINDS)} | gain of shading | gap |", "|---" * 8 + "|"]
    for row in rows:
        scores = " | ".join(f"{row[kind]:.1f}" for kind in KINDS)
        out.append(
            f"| {row['pair']} | {row['hour']} | {scores} | {row['shading'] - row['off']:+.1f} | {row['gap']:.2%} |"
        )
    for hour in HOURS:
        of = [row for row in rows if row["hour"] == hour]
        scores = " | ".join(f"{mean(row[kind] for row in of):.1f}" for kind in KINDS)
        more = mean(row["shading"] - row["off"] for row in of)
        out.append(f"| mean | {hour} | {scores} | {more:+.1f} | {max(row['gap'] for row in of):.2%} at most |")
    return out


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=Path, metavar="PNG", help="write one pair from four sides, too")
    args = parser.parse_args(argv)
    pictures: list[np.ndarray] = []
    rows = [row for host, thing in PAIRS for row in measure(host, thing, pictures)]
    print("\n".join(table(rows)))
    if args.pictures:
        write_png(args.pictures, np.hstack(pictures))
    gains = {h: [row["shading"] - row["off"] for row in rows if row["hour"] == h] for h in HOURS}
    reached = sum(gain >= GAIN for each in gains.values() for gain in each)
    print(f"\nshading gains {GAIN:g} dB or more in {reached} of {len(rows)} rows")
    fails = [f"by {hour} it gains {mean(each):.1f} dB" for hour, each in gains.items() if mean(each) < GAIN]
    fails += ["the thing hovers or sinks"] if max(row["gap"] for row in rows) > CONTACT else []
    fails += ["splats that were there have changed"] if not all(row["same"] for row in rows) else []
    print(f"\n{'MISSED: ' + '; '.join(fails) if fails else 'MET'}")
    return 1 if fails else 0


if __name__ == "__main__":
    sys.exit(main())
