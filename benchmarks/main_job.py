"""Every edit that the shipped model knows of a synthetic scene, through the main job: python benchmarks/main_job.py

For each instruction, at held-out views and against the truth: the unedited scene, `configs/dc-ge.yaml` in both modes,
and the ceiling: splats fitted (L1, the same steps) to the prior's own edits of the training views, each sampled once.
Some minutes an instruction on two cores; --instructions takes some only, --table keeps what was run and goes on.
Then the edits that add something, on the prior that knows the truth (benchmarks/growing.py), in a table of their own;
--growing runs these alone.
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

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "custom"))

import growing  # noqa: E402
from dreamcatalyst.demo.edits import find_edit, possible  # noqa: E402
from dreamcatalyst.demo.worlds import make_world  # noqa: E402

CEILING = [  # each view's edit is sampled from (nearly) pure noise at its first visit, and never again
    "system.guidance.rule=in2n",
    "system.guidance.per_editing_step=0",
    "system.guidance.edit_min_percent=0.99",
    "system.guidance.edit_max_percent=0.99",
    "system.guidance.guidance_scale=2",  # about where its samples are best (benchmarks/prior.py)
    "system.guidance.prior.freeu.mode=none",
    "system.guidance.reduction=mean",  # of an L1 of pictures, of weight 10 in GaussianEditor
    "system.loss.lambda_guidance=10",
    "system.learning_rates.sh0=[0,0.15,0.01,200]",  # its own, whatever suits the rule
]
RUNS = {"high-quality": [], "fast": ["system.mode=fast"], "ceiling": CEILING}
COLUMNS = ("unedited", "high-quality", "fast", "ceiling")


def launch(folder: Path, name: str, instruction: str, source: str, more: list[str]) -> dict[str, float]:
    """One run; PSNR inside (of everything, for global edits) and outside, the unedited one, and seconds in all."""
    given = [f"data.source={source}", f"system.prompt_processor.prompt={instruction}", f"exp_root_dir={folder}"]
    given += ["name=run", f"tag={name}", "use_timestamp=false", "system.report.video_frames=0", *more]
    if find_edit(instruction).scope == "global":  # what the mask by relevance would find out
        given += ["system.mask.kind=none"]
    command = [sys.executable, str(ROOT / "launch.py"), "--config", str(ROOT / "configs/dc-ge.yaml"), *given]
    started = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ)
    seconds = time.perf_counter() - started
    report = folder / "run" / name / "report"
    mean = json.loads((report / "summary.json").read_text(encoding="utf-8"))["mean"]
    with (report / "error.csv").open(encoding="utf-8") as file:
        first = next(csv.DictReader(file))
    key = "psnr_truth_inside" if "psnr_truth_inside" in mean else "psnr_truth"
    out = {"inside": mean[key], "unedited": float(first[key]), "seconds": seconds}
    return out | ({"outside": mean["psnr_source_outside"]} if "psnr_source_outside" in mean else {})


def line(instruction: str, row: dict[str, dict[str, float]]) -> str:
    """One line of the table."""
    best = row["high-quality"]
    cells = [f"{best['unedited']:.1f}", *(f"{row[name]['inside']:.1f}" for name in COLUMNS[1:])]
    gains = [f"{best['inside'] - best['unedited']:+.1f}", f"{row['ceiling']['inside'] - best['inside']:.1f}"]
    outside = [f"{row[name]['outside']:.1f}" if "outside" in row[name] else "-" for name in ("high-quality", "fast")]
    seconds = [f"{row[name]['seconds']:.0f}" for name in ("high-quality", "fast")]
    return f"| {instruction} | {' | '.join([*cells, *gains, *outside, *seconds])} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instructions", nargs="+", help="by default the first wording of every edit of that world")
    parser.add_argument("--source", default="demo:statue", help="a synthetic scene")
    parser.add_argument("--table", type=Path, default=Path("outputs/main_job.json"), help="results, kept and added to")
    parser.add_argument("--picture", type=Path, help="write source, result and truth of every instruction")
    parser.add_argument("--growing", action="store_true", help="only the edits that add something")
    args = parser.parse_args()
    if args.growing and args.instructions:
        parser.error("--growing: has instructions of its own; leave --instructions out")
    world = make_world(args.source.removeprefix("demo:"))
    known = [edit.phrases[0] for edit in possible(world) if edit.phrases[0] and not edit.adds]
    for instruction in args.instructions or ():
        if find_edit(instruction) not in possible(world) or find_edit(instruction).adds:
            parser.error(f"--instructions: {args.source} has no edit '{instruction}', expected wordings of: {known}")
    args.table.parent.mkdir(parents=True, exist_ok=True)
    results = json.loads(args.table.read_text(encoding="utf-8")) if args.table.exists() else {}
    rows = []
    asked = [] if args.growing else args.instructions or known
    for instruction in asked:
        row = results.setdefault(instruction, {})
        for name, more in RUNS.items():
            if name in row:
                continue
            with tempfile.TemporaryDirectory() as folder:
                row[name] = launch(Path(folder), name, instruction, args.source, more)
                if name == "high-quality":
                    pictures = sorted((Path(folder) / "run" / name / "save").glob("it*-comparison.png"))
                    strip = cv2.imread(str(pictures[-1]))
                    cv2.imwrite(str(args.table.with_suffix("")) + f"-{instruction.replace(' ', '_')}.png", strip)
            args.table.write_text(json.dumps(results, indent=1), encoding="utf-8")
            print(f"{instruction}, {name}: {row[name]}", file=sys.stderr, flush=True)
    if asked:
        print(
            "| instruction | unedited | high-quality | fast | ceiling | gain | below it | outside | fast | s | fast |"
        )
        print("|---|---|---|---|---|---|---|---|---|---|---|")
    for instruction in asked:
        print(line(instruction, results[instruction]))
        rows.append(str(args.table.with_suffix("")) + f"-{instruction.replace(' ', '_')}.png")
    if not args.instructions:
        grown = results.setdefault("growing", {})
        growing.measure(
            grown, args.source, lambda: args.table.write_text(json.dumps(results, indent=1), encoding="utf-8")
        )
        print("\n".join(["", *growing.table(grown)]))
    if args.picture and rows:
        strips = [cv2.imread(path) for path in rows]
        cv2.imwrite(str(args.picture), np.vstack([strip[: strip.shape[0] // 4] for strip in strips]))


if __name__ == "__main__":
    main()
