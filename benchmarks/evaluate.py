"""The paper's evaluation: a list of edits over a folder of scenes, each edited by one or several configs, in a table.

python benchmarks/evaluate.py --scenes <folder> --config configs/dc-ge-ip2p.yaml system.report.clip=<folder or id>

<folder>/<scene> is a capture, with its splats in splats.ply; where there are none, configs/fit.yaml makes them first. A
list of one's own: --pairs, a YAML like custom/dreamcatalyst/report/paper_pairs.yaml (the default, the paper's 40); a
scene called demo:... is a made world. Started again, it goes on: pairs that are done are only read. Views are those
held out, at the config's size; figures are means over pairs, minutes those of the steps. key=value goes to each run.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "custom"))

from dreamcatalyst.config import load_config  # noqa: E402
from dreamcatalyst.demo.capture import PREFIX  # noqa: E402
from dreamcatalyst.errors import DreamCatalystError  # noqa: E402
from dreamcatalyst.files import load  # noqa: E402
from dreamcatalyst.report.evaluation import PAPER_PAIRS, Pair, read_pairs, table  # noqa: E402


def launch(trial: Path, config: Path, given: list[str]) -> None:
    """Run the launcher into `trial`, from its last checkpoint where there is one: to its end, or where it has been
    there, to its scores. What it says goes to a file there."""
    trial.mkdir(parents=True, exist_ok=True)
    where = [
        f"exp_root_dir={trial.parents[1]}",
        f"name={trial.parent.name}",
        f"tag={trial.name}",
        "use_timestamp=false",
    ]
    checkpoint = trial / "ckpts" / "last.ckpt"
    resume = [f"resume={checkpoint}"] if checkpoint.is_file() else []
    if resume and load(checkpoint)[0]["global_step"] >= load_config(config, cli_args=given).trainer["max_steps"]:
        resume.append("--test")
    command = [sys.executable, str(ROOT / "launch.py"), "--config", str(config), *where, *given, *resume]
    with (trial / "evaluate.log").open("w", encoding="utf-8") as log:
        subprocess.run(command, stdout=log, stderr=subprocess.STDOUT)


def finished(trial: Path) -> dict | None:
    """The summary of a run that was scored to its end, None where there is none yet."""
    file = trial / "report" / "summary.json"
    summary = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    return summary if summary.get("held_out") else None


def splats(scene: str, scenes: Path, output: Path, more: list[str]) -> tuple[str, str] | None:
    """Source and splats of a scene, fitted where there are none; None where the fit failed (and left a log)."""
    if scene.startswith(PREFIX):
        return scene, "''"
    folder = scenes / scene
    if (folder / "splats.ply").is_file():
        return str(folder), str(folder / "splats.ply")
    trial = output / "fit" / scene
    sized = [option for option in more if option.startswith(("data.", "trainer.accelerator"))]
    if not finished(trial):
        launch(trial, ROOT / "configs" / "fit.yaml", [f"data.source={folder}", *sized])
    return (str(folder), str(trial / "save" / "last.ply")) if finished(trial) else None


def words(pair: Pair, config: Path, more: list[str]) -> list[str]:
    """What a config is told of a pair: an instruction, or descriptions where its prior is text-to-image."""
    guidance = yaml.safe_load(config.read_text(encoding="utf-8"))["system"].get("guidance", {})
    told = {"prompt": pair.instruction}
    if guidance.get("prior_type") == "sd":
        told = {"prompt": pair.target, "source_prompt": pair.source}
    given = [f"system.prompt_processor.{key}={text}" for key, text in told.items()]
    if any(option.startswith("system.report.clip=") for option in more):
        given += [f"system.report.clip_source={pair.source}", f"system.report.clip_target={pair.target}"]
    return given


def scores(trial: Path) -> dict[str, float]:
    """The means of a finished run, with its minutes."""
    summary = finished(trial)
    return {**summary["mean"], "minutes": summary["seconds"] / 60}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, default=Path(), help="the folder of the scenes' folders")
    parser.add_argument("--pairs", type=Path, default=PAPER_PAIRS, help="a list of edits")
    parser.add_argument("--config", type=Path, action="append", help="a method; several, one after the other")
    parser.add_argument("--output", type=Path, default=Path("outputs/evaluate"), help="the folder of all runs")
    args, more = parser.parse_known_args(argv)
    pairs, methods = read_pairs(args.pairs), args.config or [ROOT / "configs/dc-ge-ip2p.yaml"]
    there = {p.scene for p in pairs if p.scene.startswith(PREFIX) or (args.scenes / p.scene).is_dir()}
    missing = sorted({p.scene for p in pairs} - there)
    if missing:
        print(f"left out, since {args.scenes} has no such folder: {', '.join(missing)}", file=sys.stderr)
    results: dict[str, dict[Pair, dict[str, float]]] = {}
    failed = [] if there else ["every pair"]
    for pair in (p for p in pairs if p.scene in there):
        found = splats(pair.scene, args.scenes, args.output, more)
        for config in methods:
            trial = args.output / config.stem / pair.name
            if found and not finished(trial):
                print(f"{config.stem}: {pair.scene}, {pair.instruction}", file=sys.stderr, flush=True)
                given = [f"data.source={found[0]}", f"system.gs_source={found[1]}", *words(pair, config, more), *more]
                launch(trial, config, given)
            if finished(trial):
                results.setdefault(config.stem, {})[pair] = scores(trial)
            else:
                failed.append(f"{config.stem}, {pair.scene}: {pair.instruction}: see {trial / 'evaluate.log'}")
    text = table(results)
    args.output.mkdir(parents=True, exist_ok=True)
    (args.output / "table.md").write_text(text + "\n", encoding="utf-8")
    print(text)
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except DreamCatalystError as error:
        sys.exit(f"error: {error}")
