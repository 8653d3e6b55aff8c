"""What the DreamCatalyst rule reaches on an exact prior, between two bounds: the unedited scene, and splats that are
fitted directly to the known edit for the same seconds.

python benchmarks/first_edit.py --source <capture folder> --splats <PLY>    (without both: the made statue)
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "custom")]
INSTRUCTIONS = ("Make it sunset", "Make it night", "Make it autumn", "Make it look like just snowed", "Make it golden")
PROBE = 120  # steps that tell how long one takes; the first few are slower


def run(folder: Path, name: str, arguments: list[str]) -> dict[str, float]:
    """One run through the launcher: its mean scores at held-out views, its seconds and steps."""
    import launch

    options = [
        f"exp_root_dir={folder}",
        f"name={name}",
        "tag=run",
        "use_timestamp=false",
        "system.report.video_frames=0",
        "system.report.overhead=1",  # its clock stands still in reports, and the curve is what this is about
    ]
    arguments = ["--config", str(ROOT / "configs" / "closed-form.yaml"), *options, *arguments]
    if launch.main(arguments):
        sys.exit(f"{name}: the run failed")
    summary = json.loads((folder / name / "run" / "report" / "summary.json").read_text())
    return {"seconds": summary["seconds"], "steps": summary["step"], **summary["mean"]}


def curve(folder: Path, name: str):
    """The error curve that a run left."""
    from dreamcatalyst.report.curve import Curve

    with (folder / name / "run" / "report" / "error.csv").open() as file:
        return Curve([{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(file)])


def picture(folder: Path, rows: list[dict[str, object]], path: Path, views: int = 2) -> None:
    """Held-out views under each other: the source, then what each instruction made of it."""
    import cv2
    import numpy as np
    from dreamcatalyst.report.pictures import BAR

    lines = []
    for view in range(views):
        cells = []
        for row in rows:
            drawn = sorted((folder / row["name"] / "run" / "save").glob("it*-test/*.png"), key=lambda f: int(f.stem))
            panels = np.split(
                cv2.imread(str(drawn[view * len(drawn) // views])), 3, axis=1
            )  # source, edited, known edit
            label = np.full((BAR, panels[1].shape[1], 3), 255, np.uint8)
            cv2.putText(
                label, row["instruction"], (2, BAR - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 1, cv2.LINE_AA
            )
            cells += [] if cells else [panels[0]]
            cells.append(np.vstack([label, panels[1][BAR:]]))
        lines.append(np.hstack(cells))
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.vstack(lines))


def compare(folder: Path, instruction: str, common: list[str], steps: int) -> dict[str, object]:
    """The rule's run and the bounds on both sides of it."""
    name = instruction.lower().replace(" ", "-")
    prompt = f"system.prompt_processor.prompt={instruction}"
    rule = run(folder, name, [*common, prompt, f"trainer.max_steps={steps}"])
    direct = [*common, prompt, "system.guidance.rule=known-edit"]
    probe = run(folder, f"{name}-probe", [*direct, f"trainer.max_steps={PROBE}", "system.report.every=0"])
    fill = max(PROBE, round(rule["seconds"] / (probe["seconds"] / PROBE)))
    ceiling = run(folder, f"{name}-ceiling", [*direct, f"trainer.max_steps={fill}"])
    first = curve(folder, name).rows[0]
    return {"instruction": instruction, "unedited": first["psnr_edit"], "rule": rule, "ceiling": ceiling, "name": name}


def main() -> None:
    """Print the table; draw the curves."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--source", help="capture folder; without it, the made statue")
    parser.add_argument("--splats", help="PLY of the capture's splats, from configs/fit.yaml")
    parser.add_argument("--instructions", nargs="+", default=INSTRUCTIONS)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--plot", type=Path, help="SVG of the error curves to write")
    parser.add_argument("--picture", type=Path, help="PNG of the edits side by side to write")
    parser.add_argument("overrides", nargs="*", help="key=value for all runs, such as data.downscale=4")
    args = parser.parse_args()
    common = list(args.overrides)
    if args.source:
        common += [f"data.source={args.source}", f"system.gs_source={args.splats or ''}"]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        rows = [compare(folder, instruction, common, args.steps) for instruction in args.instructions]
        if args.picture:
            picture(folder, rows, args.picture)
        if args.plot:
            from dreamcatalyst.report.chart import line_chart, picture_file

            charts = []
            for row in rows:
                runs = {"rule": row["name"], "ceiling": f"{row['name']}-ceiling"}
                curves = {label: curve(folder, name).rows for label, name in runs.items()}
                lines = {k: [(r["seconds"], r["psnr_edit"]) for r in v if "psnr_edit" in r] for k, v in curves.items()}
                charts.append(line_chart(f"{row['instruction']}: PSNR against the known edit, dB", lines))
            args.plot.write_text(picture_file(charts), encoding="utf-8")
    print("\nPSNR (dB) of held-out views against the known edit\n")
    print("| instruction | unedited | rule | ceiling | below it | SSIM rule | SSIM ceiling | steps | seconds |")
    print("|---|---|---|---|---|---|---|---|---|")
    for row in rows:
        rule, ceiling = row["rule"], row["ceiling"]
        gap = ceiling["psnr_edit"] - rule["psnr_edit"]
        print(
            f"| {row['instruction']} | {row['unedited']:.1f} | {rule['psnr_edit']:.1f} | {ceiling['psnr_edit']:.1f} "
            f"| {gap:.1f} | {rule['ssim_edit']:.3f} | {ceiling['ssim_edit']:.3f} | {rule['steps']} "
            f"| {rule['seconds']:.0f} |"
        )


if __name__ == "__main__":
    main()
