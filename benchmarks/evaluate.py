"""The paper's evaluation: a list of edits over a folder of scenes, each edited by several methods, in a table.

python benchmarks/evaluate.py --scenes <folder> system.report.clip=<folder or id> system.report.aesthetic=<file>

All rows of the paper's table on 3DGS but DGE, GaussianEditor with PDS, and what we recommend; or the methods that are
named: --config, one or several YAMLs. <folder>/<scene> is a capture, with its splats in splats.ply; where there are
none, configs/fit.yaml makes them first, as finely as edits at 512 x 512 need and as long as 3DGS does (--fit key=value
changes that). A list of one's own: --pairs, a YAML like custom/dreamcatalyst/report/paper_pairs.yaml (the default, the
paper's 40); a scene called demo:... is a synthetic scene. Started again, it goes on: pairs that are done are only read.

What makes methods comparable is the same for all: splats, views, and the mask, which the list's words find (a config
without a mask, such as the model-agnostic ones, stays so). Views are those held out, at the config's size; published
codes train on the views that they score, as --test-every 0 does. Figures are means over pairs, minutes those of the
steps, and compare only with one another: CLIP's direction of one method differs threefold between papers. key=value
goes to each run.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import yaml
from omegaconf import OmegaConf

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "custom"))

from dreamcatalyst.config import load_config, read_yaml  # noqa: E402
from dreamcatalyst.demo.capture import PREFIX  # noqa: E402
from dreamcatalyst.errors import DreamCatalystError  # noqa: E402
from dreamcatalyst.files import load  # noqa: E402
from dreamcatalyst.report.evaluation import (  # noqa: E402
    EVERYTHING,
    METHODS,
    PAPER_PAIRS,
    Method,
    Pair,
    read_pairs,
    table,
    views_note,
)

# As 3DGS fits (Kerbl et al. 2023): an edit at 512 x 512 sees a crop of it, and scores of a blur are scores of nothing.
FIT = (
    "data.max_side=1600",
    "trainer.max_steps=30000",
    "system.densify.start=500",
    "system.densify.reset_every=3000",
    "system.densify.max_splats=3000000",
)
FINDER = {"path": "IDEA-Research/grounding-dino-tiny", "sam": "facebook/sam-vit-base"}


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


def splats(scene: str, scenes: Path, output: Path, given: list[str]) -> tuple[str, str] | None:
    """Source and splats of a scene, fitted where there are none; None where the fit failed (and left a log)."""
    if scene.startswith(PREFIX):
        return scene, "''"
    folder = scenes / scene
    if (folder / "splats.ply").is_file():
        return str(folder), str(folder / "splats.ply")
    trial = output / "fit" / scene
    if not finished(trial):
        launch(trial, ROOT / "configs" / "fit.yaml", [f"data.source={folder}", *given])
    return (str(folder), str(trial / "save" / "last.ply")) if finished(trial) else None


def masked(config: Path) -> bool:
    """Whether a config knows a mask at all."""
    return read(config)["system"].get("mask", {}).get("kind", "none") != "none"


def read(config: Path) -> dict:
    """A config as it stands, over its base where it has one."""
    return OmegaConf.to_container(read_yaml(config))


def on_one_mask(config: Path, region: str, output: Path) -> Path:
    """The config with the mask that all methods share, in a file of its own; as it is where it knows no mask."""
    if not masked(config):
        return config
    values = read(config)
    values["system"]["mask"] = {"kind": "none"}
    if region != EVERYTHING:
        found = {"kind": "text", "options": {"text": region, **FINDER}}
        values["system"]["mask"] = {**found, "cache": str(output.resolve() / "masks")}
    words = "".join(c if c.isalnum() else "-" for c in region)
    made = output / "configs" / f"{config.stem}-{words}.yaml"
    made.parent.mkdir(parents=True, exist_ok=True)
    made.write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")
    return made


def words(pair: Pair, config: Path, more: list[str]) -> list[str]:
    """What a config is told of a pair: an instruction, or descriptions where its prior is text-to-image."""
    guidance = read(config)["system"].get("guidance", {})
    told = {"prompt": pair.instruction}
    if guidance.get("prior_type") == "sd":
        told = {"prompt": pair.target, "source_prompt": pair.source}
    given = [f"system.prompt_processor.{key}={text}" for key, text in told.items()]
    if any(option.startswith("system.report.clip=") for option in more):
        given += [f"system.report.clip_source={pair.source}", f"system.report.clip_target={pair.target}"]
    return given


def options_of(pair: Pair, config: Path, more: list[str]) -> list[str]:
    """Those of `more` that a run takes: what is said of the finder of masks says nothing where there is none."""
    if masked(config) and pair.region != EVERYTHING:
        return more
    return [option for option in more if not option.startswith("system.mask.")]


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
    parser.add_argument("--fit", action="append", default=[], metavar="KEY=VALUE", help="of the fits; again for more")
    parser.add_argument(
        "--test-every",
        type=int,
        default=8,
        help="every so many views one is held out of fits and edits, and scored; 0: all are trained on and scored, as "
        "the published codes do",
    )
    args, more = parser.parse_known_args(argv)
    pairs, methods = read_pairs(args.pairs), METHODS
    if args.config:
        methods = [Method(config.stem, str(config.resolve())) for config in args.config]
    there = {p.scene for p in pairs if p.scene.startswith(PREFIX) or (args.scenes / p.scene).is_dir()}
    missing = sorted({p.scene for p in pairs} - there)
    if missing:
        print(f"left out, since {args.scenes} has no such folder: {', '.join(missing)}", file=sys.stderr)
    results: dict[str, dict[Pair, dict[str, float]]] = {}
    failed = [] if there else ["every pair"]
    every = f"data.test_every={args.test_every}"
    sized = [option for option in more if option.startswith(("data.", "trainer.accelerator"))]
    for pair in (p for p in pairs if p.scene in there):
        found = splats(pair.scene, args.scenes, args.output, [*FIT, every, *sized, *args.fit])
        for method in methods:
            trial = args.output / method.name / pair.name
            if found and not finished(trial):
                print(f"{method.name}: {pair.scene}, {pair.instruction}", file=sys.stderr, flush=True)
                config = on_one_mask(ROOT / method.config, pair.region, args.output)
                given = [f"data.source={found[0]}", f"system.gs_source={found[1]}", every, *method.options]
                launch(trial, config, [*given, *words(pair, config, more), *options_of(pair, config, more)])
            if finished(trial):
                results.setdefault(method.name, {})[pair] = scores(trial)
            else:
                failed.append(f"{method.name}, {pair.scene}: {pair.instruction}: see {trial / 'evaluate.log'}")
    unmasked = [method.name for method in methods if not masked(ROOT / method.config)]
    text = f"{table(results, unmasked)}\n\n{views_note(args.test_every)}"
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
