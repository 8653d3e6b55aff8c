"""Work-precision diagrams: error against seconds of every rule, in as many cells as a budget allows.

python benchmarks/error_vs_time.py --minutes 90 --write    (a further call goes on; --minutes 0 only writes)

A cell is one run of the launcher: a method on an edit with a seed. Methods are first tuned, each by as many trials, on
other scenes: a common factor on all learning rates, and the guidance scale. On the closed form the scale is known: the
one whose fixed point is the edit. Then come the methods on all edits, ablations, and the further seeds. Results are
kept as JSON lines under a digest of all that defines a run. It wants the machine for itself.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "custom"), str(ROOT)]

from benchmarks.precision.cells import (  # noqa: E402
    FAMILIES,
    GUIDANCE,
    METHODS,
    Bench,
    Case,
    Settings,
    affordable,
    number,
    remaining,
)
from benchmarks.precision.document import generated, write  # noqa: E402
from benchmarks.precision.runner import Runner, plain  # noqa: E402

QUICK_STEPS = 16
STATUE = ("data.source=demo:statue",)
EVERYTHING = ("system.mask.kind=none",)  # which the mask by relevance would find out
DEMO = (
    Case("panda", "Turn the bear statue into a panda", STATUE, ablated=True),
    Case("autumn", "Make it autumn", STATUE + EVERYTHING, ablated=True),
    Case("bronze", "Turn the bear statue into a bronze statue", STATUE),
    Case("snow", "Make it look like just snowed", STATUE + EVERYTHING),
)
# What all rules begin with: noise as published, levels that suit all, rates of the colours for runs of few steps.
ALIKE = (
    "system.guidance.noise=independent",
    "system.guidance.min_step_percent=0.35",
    'system.learning_rates.sh0=[0,0.15,0.01,"${trainer.max_steps}"]',
)
DEMO_TUNING = (  # worlds whose seeds are for judging: the prior has seen none of them
    Case("tune-polar", "Turn the bear statue into a polar bear", ("data.source=demo:random:5",)),
    Case("tune-sunset", "Make it sunset", ("data.source=demo:random:7", *EVERYTHING)),
)
CAPTURE = {"fox-autumn": "Make it autumn", "fox-night": "Make it night"}
CAPTURE_TUNING = (Case("tune-sunset", "Make it sunset", ("data.source=demo:random:4",)),)


def values_of(config: str, overrides: list[str]) -> dict[str, Any]:
    """What stands in a config."""
    from dreamcatalyst.config import load_config

    return {"system": plain(load_config(config, cli_args=overrides).system)}


def demo_bench(args: argparse.Namespace) -> Bench | str:
    """The edits of a synthetic scene with the small prior; in words, why not."""
    from dreamcatalyst.diffusion.hub import SHIPPED, SHIPPED_NAME

    given = [*ALIKE, *([f"system.guidance.prior.path={Path(args.prior).resolve()}"] if args.prior else [])]
    config = str(Path(args.config).resolve())
    values = values_of(config, given)
    guidance = values["system"]["guidance"]
    if guidance["prior_type"] != "ip2p":
        return f"edits of synthetic scenes: the prior of {args.config} is {guidance['prior_type']}, expected ip2p"
    if guidance["prior"]["path"] == SHIPPED_NAME and not SHIPPED.is_dir():
        return f"edits of synthetic scenes: the small model is not in {SHIPPED} (--prior names another folder)"
    families = tuple(name for name in FAMILIES if name != "known-edit")
    size = (f"data.width={args.size}", f"data.height={args.size}")
    title = "Edits of a synthetic scene, by the small model, against the truth"
    overrides = (*given, *size)
    return Bench("demo", title, config, values, families, DEMO, DEMO_TUNING, args.length, overrides)


def capture_bench(args: argparse.Namespace) -> Bench | str:
    """Edits of a real capture on the exact prior, all rules at rest at T(I); in words, why not."""
    from dreamcatalyst.config import parse
    from dreamcatalyst.guidance.config import GuidanceConfig

    from benchmarks.precision.balance import balanced_scale, common_prior

    capture = Path(args.capture).resolve()
    if not capture.is_dir():
        return f"edits of a real capture: there is no folder {args.capture} (--capture)"
    made = sorted((ROOT / "outputs" / "fit").glob(f"{capture.name}*/save/last.ply"), key=lambda p: p.stat().st_mtime)
    splats = Path(args.splats).resolve() if args.splats else made[-1] if made else None
    if splats is None or not splats.is_file():
        return f"edits of a real capture: no splats of it (--splats); configs/fit.yaml makes some of {args.capture}"
    config = str(ROOT / "configs" / "closed-form.yaml")
    place = (f"data.source={capture}", f"system.gs_source={splats}")
    cases = tuple(Case(name, words, place) for name, words in CAPTURE.items())
    title = "Edits of a real capture, on the exact prior, against T(I)"
    overrides = (f"data.max_side={args.size}", "system.guidance.condition_scale=1")
    bench = Bench("closed-form", title, config, {}, tuple(FAMILIES), cases, CAPTURE_TUNING, args.length, overrides)

    def guidance(family: str) -> GuidanceConfig:
        given = [f"{GUIDANCE}{setting}" for setting in FAMILIES[family].settings]
        return parse(GuidanceConfig, values_of(config, given)["system"]["guidance"], "system.guidance")

    prior = common_prior(guidance("dreamcatalyst"))
    scales = {family: balanced_scale(prior, guidance(family)) for family in bench.families}
    spread = f"{GUIDANCE}prior.s_image={number(prior.config.s_image)}"
    return replace(bench, values=values_of(config, []), scales=scales, overrides=(*overrides, spread))


def make_settings(args: argparse.Namespace) -> tuple[Settings, list[str]]:
    """The table, and what it leaves out for which reasons."""
    made = [demo_bench(args), *([] if args.quick else [capture_bench(args)])]
    benches = tuple(bench for bench in made if isinstance(bench, Bench))
    left_out = [reason for reason in made if isinstance(reason, str)]
    if not args.quick:
        return Settings(benches, seeds=tuple(range(args.seeds)), trials=args.trials), left_out
    steps = [bench.values["system"]["steps"]["high-quality"] for bench in benches]
    few = [replace(b, cases=b.cases[:1], length=QUICK_STEPS / n) for b, n in zip(benches, steps, strict=True)]
    two = tuple(method for method in METHODS if method.name in ("dreamcatalyst", "pds"))
    return Settings(tuple(few), two, seeds=(0,), trials=0, ablations=False), left_out


def run_all(settings: Settings, runner: Runner, minutes: float) -> None:
    """Run cell after cell while the budget lasts."""
    began = time.perf_counter()
    for cell in remaining(settings, runner.lookup):
        if not affordable(time.perf_counter() - began, 60 * minutes, runner.walls(cell)):
            print(f"the budget of {minutes:g} minutes is spent; the next call goes on", file=sys.stderr)
            return
        row = runner.run(cell)
        outcome = (
            row.get("failed") or f"{row['error'][0]:.2f} to {row['error'][-1]:.2f} dB in {row['seconds'][-1]:.1f} s"
        )
        name = f"{cell.bench} {cell.case}, {cell.label}, seed {cell.seed}"
        spent = (time.perf_counter() - began) / 60
        print(f"[{spent:5.1f} min] {cell.group}: {name}: {outcome}", file=sys.stderr, flush=True)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=90, help="a cell begins only if it is likely to end in time")
    parser.add_argument("--quick", action="store_true", help="two rules, one edit, one seed, few steps, nothing tuned")
    parser.add_argument("--config", default=str(ROOT / "configs" / "dc-ge.yaml"), help="of edits of synthetic scenes")
    parser.add_argument("--prior", help="a model folder in place of the config's")
    parser.add_argument("--capture", default=str(ROOT.parent / "shared/scenes/fox"), help="a real capture's folder")
    parser.add_argument("--splats", help="PLY of its splats; by default the newest one of outputs/fit")
    parser.add_argument("--size", type=int, default=128, help="pixels, longer side")
    parser.add_argument("--length", type=float, default=0.5, help="of all runs, in units of the configs' steps")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--trials", type=int, default=5, help="of each rule's tuning; 0: as configured")
    parser.add_argument("--results", type=Path, default=ROOT / "outputs" / "error_vs_time.jsonl", help="kept, added to")
    parser.add_argument(
        "--write", type=Path, nargs="?", const=ROOT / "docs" / "error-vs-time.md", help="the document; plots beside it"
    )
    args = parser.parse_args(argv)
    settings, left_out = make_settings(args)
    for reason in left_out:
        print(f"left out: {reason}", file=sys.stderr)
    if not settings.benches:
        return 1
    runner = Runner(args.results, args.results.with_suffix(""))
    try:
        if args.minutes > 0:
            run_all(settings, runner, args.minutes)
    except KeyboardInterrupt:
        print("interrupted; the next call goes on", file=sys.stderr)
        return 130
    if args.write:
        write(args.write, settings, runner.lookup, left_out)
        print(f"wrote {args.write}", file=sys.stderr)
    else:
        print(generated(settings, runner.lookup, left_out, args.results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
