"""What anchors do in the main job: python benchmarks/anchor_edits.py [--edits gold] [--anchors none loss]

For gold and bronze, which leave the statue's shape as it is, and the panda, by each kind of anchor: how far the splats
that were there from the beginning moved (world units), how much the logarithms of their scales changed, and PSNR at
held-out views against the truth where the statue is and against the source elsewhere. One to two minutes a run.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "custom"))

from dreamcatalyst.demo.edits import apply_edit, find_edit  # noqa: E402
from dreamcatalyst.demo.worlds import World, make_world  # noqa: E402
from dreamcatalyst.render.api import rasterize  # noqa: E402
from dreamcatalyst.report.metrics import psnr  # noqa: E402
from dreamcatalyst.scene.ply import read_ply, write_ply  # noqa: E402

EDITS = {
    "gold": "Turn the bear statue golden",
    "bronze": "Turn the bear statue into a bronze statue",
    "panda": "Turn the bear statue into a panda",
}
ANCHOR = "system.anchor."
ANCHORS = {
    "none": [f"{ANCHOR}kind=none"],
    "loss": [f"{ANCHOR}form=loss", f"{ANCHOR}lambda_color=5"],
    "proximal-0.1-colours": [f"{ANCHOR}proximal_rate=0.1", f"{ANCHOR}lambda_color=5"],
    "proximal-0.2-colours": [f"{ANCHOR}proximal_rate=0.2", f"{ANCHOR}lambda_color=5"],
    "proximal-0.2": [],  # the default
}
ROW, TEST_EVERY, THRESHOLD = "row", 8, 0.1  # the extra that numbers the source's splats; of configs/dc-ge.yaml


@torch.no_grad()
def judge(folder: Path, world: World, instruction: str) -> list[str]:
    """The cells of one run."""
    last = read_ply(folder / "save/last.ply")
    rows = last.extra[ROW].reshape(-1).long()
    first = torch.full((len(world.scene),), len(rows)).scatter_reduce(0, rows, torch.arange(len(rows)), "amin")
    kept = first[first < len(rows)]  # survivors stand before children, which have their parents' numbers
    kept = kept[last.extra["mask"].reshape(-1)[kept] >= THRESHOLD]
    moved = (last.means - world.scene.means[rows]).norm(dim=1)[kept].mean()
    scaled = (last.log_scales - world.scene.log_scales[rows]).abs().mean(dim=1)[kept].mean()
    truth, cameras = apply_edit(world, find_edit(instruction).name), world.cameras[::TEST_EVERY]
    statue = truth.means.new_zeros(len(truth), 1)
    statue[slice(*world.thing("bear statue").rows)] = 1
    want, before = (rasterize(scene, cameras, features=statue) for scene in (truth, world.scene))
    where, got = torch.maximum(want.features, before.features).round(), rasterize(last, cameras).rgb.clamp(0, 1)
    inside = psnr(got, want.rgb.clamp(0, 1), where).mean()
    outside = psnr(got, before.rgb.clamp(0, 1), 1 - where).mean()
    with (folder / "report/error.csv").open(encoding="utf-8") as file:
        row = list(csv.DictReader(file))[-1]
    share = row.get("share_anchor") or row.get("share_anchor_step") or "0"
    return [f"{1e3 * moved:.2f}", f"{scaled:.3f}", f"{inside:.1f}", f"{outside:.1f}", f"{float(share):.4f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--edits", nargs="+", choices=EDITS, default=list(EDITS))
    parser.add_argument("--anchors", nargs="+", choices=ANCHORS, default=list(ANCHORS))
    parser.add_argument("--steps", type=int, default=200)
    args = parser.parse_args()
    world = make_world("statue")
    print("| edit | anchors | displacement, 1e-3 | scale | inside, dB | outside, dB | share |\n" + "|---" * 7 + "|")
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "source.ply"
        write_ply(source, world.scene.with_extra(**{ROW: torch.arange(len(world.scene)).float()}))
        for edit in args.edits:
            for kind in args.anchors:
                name = f"{edit}-{kind}"
                given = [f"system.gs_source={source}", f"system.prompt_processor.prompt={EDITS[edit]}"]
                given += [f"exp_root_dir={folder}", "name=run", f"tag={name}", "use_timestamp=false"]
                given += ["system.report.video_frames=0", f"trainer.max_steps={args.steps}", *ANCHORS[kind]]
                command = [sys.executable, str(ROOT / "launch.py"), "--config", str(ROOT / "configs/dc-ge.yaml")]
                subprocess.run([*command, *given], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
                cells = judge(Path(folder) / "run" / name, world, EDITS[edit])
                print(f"| {edit} | {kind} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
