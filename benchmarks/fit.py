"""How good a fit is after how long: time from launch to the last step, and PSNR at held-out views.

Each length is a run of configs/fit.yaml in a process of its own, since the time counts from launch: imports,
photographs and the plan are in it, the scoring of the result is not. The renderer's kernels are compiled before, which
happens once after an installation. The bound is a fit of ten times the longest run's steps.

python benchmarks/fit.py --capture <folder> [--steps 1200 6000] [--bound] [--options] [key=value ...]
--options compares exposures, sampling and coarse steps with the config as it is, at the first length.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LENGTHS = (1200, 6000)
OPTIONS = {
    "as it is": [],
    "exposures": ["system.exposure=0.002"],
    "coarse to fine": ["system.coarse=0.3"],
    "sampling (mcmc)": ["system.densify.strategy=mcmc", "system.densify.every=25"],
}


def fit(capture: str, steps: int, folder: Path, given: list[str]) -> dict[str, float]:
    """Run it; seconds from launch to the last step, of processor time in all, PSNR at held-out views, and splats."""
    command = [sys.executable, str(ROOT / "launch.py"), "--config", str(ROOT / "configs/fit.yaml")]
    command += [f"data.source={capture}", "data.max_side=null", "data.downscale=4", f"trainer.max_steps={steps}"]
    command += ["system.report.video_frames=0", "system.report.pictures=0", f"exp_root_dir={folder}", "tag=run"]
    began, before = time.time(), os.times()
    run = subprocess.run([*command, "use_timestamp=false", *given], capture_output=True, text=True)
    if run.returncode:
        raise SystemExit(run.stderr)
    after, trial = os.times(), folder / "fit" / "run"
    summary = json.loads((trial / "report/summary.json").read_text())
    with (trial / "report/error.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {
        "steps": steps,
        "seconds": (trial / "save/last.ply").stat().st_mtime - began,  # written at once after the last step
        "processor": after.children_user + after.children_system - before.children_user - before.children_system,
        "training": float(rows[-1]["seconds"]),
        "splats": summary["splats"],
        "psnr": summary["mean"]["psnr_photo"],
        "ssim": summary["mean"]["ssim_photo"],
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", required=True, help="a folder of photographs with cameras")
    parser.add_argument("--steps", type=int, nargs="+", default=list(LENGTHS), help="lengths of runs")
    parser.add_argument("--bound", action="store_true", help="also ten times the longest run")
    parser.add_argument("--options", action="store_true", help="also exposures, coarse steps and sampling")
    args, given = parser.parse_known_args()
    rows = [(f"{steps:,} steps", steps, given) for steps in args.steps]
    rows += [("bound", 10 * max(args.steps), given)] if args.bound else []
    rows += [(name, args.steps[0], [*given, *more]) for name, more in OPTIONS.items()] if args.options else []
    print("| run | steps | seconds from launch | of them training | processor seconds | splats | PSNR, dB | SSIM |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|")
    with tempfile.TemporaryDirectory(prefix="fit-") as root:
        fit(args.capture, 2, Path(root) / "warm", given)  # compiles what is compiled once
        for number, (name, steps, options) in enumerate(rows):
            r = fit(args.capture, steps, Path(root) / str(number), options)
            print(
                f"| {name} | {r['steps']:,} | {r['seconds']:.0f} | {r['training']:.0f} | {r['processor']:.0f} | "
                f"{r['splats']:,} | {r['psnr']:.2f} | {r['ssim']:.3f} |",
                flush=True,
            )
    load = os.getloadavg()[0]
    print(f"\n{os.cpu_count()} cores, load {load:.1f} at the end; downscale 4, every 8th view held out.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
