"""Whether a change leaves every result as it was: 20 steps of each config that needs no download, in one checkout and
in another. A refactoring passes when PLY bytes, weights and the values of report/error.csv are equal.

python benchmarks/same_results.py --write before.json                   (in the old checkout, or --root <it>)
python benchmarks/same_results.py --against before.json                 (in the new one: status 1 where any differs)
python benchmarks/same_results.py --capture ../shared/scenes/fox ...    (configs that need a capture, too)

One thread each, two runs at a time. Each config runs once before it is measured, because a process that compiles
kernels may round otherwise than one that loads them.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[1]
STEPS = 20
TIMED = ("seconds", "memory", "change_per_second")  # how columns begin that no two runs share
SMALL = {  # what makes 20 steps of a config short, and leaves what it does as it is
    "configs/prior.yaml": [
        "data.count=96",
        "data.held_out=16",
        "data.photographs=false",
        f"system.autoencoder.steps={STEPS}",
        f"system.unet.steps={STEPS}",
        "system.samples.every=0",
    ],
}
REPORT = ["system.report.every=5", "system.report.overhead=1000", "system.report.video_frames=0"]
RUN = [f"trainer.max_steps={STEPS}", *REPORT]
MORE = [["system.guidance.rule=" + rule] for rule in ("sds", "dds", "pds", "csd-like", "in2n", "known-edit")] + [
    ["system.densify.every=5", "system.densify.start=0", "system.anchor.kind=source", "system.anchor.form=loss"],
    ["system.mask.kind=relevance", "system.densify.every=5", "system.densify.start=0", "system.densify.candidates=0.1"],
    ["system.renderer.backend=reference", "data.width=32", "data.height=32"],
]  # of configs/closed-form.yaml: what no config asks for


def runs(root: Path, capture: str) -> list[tuple[str, list[str]]]:
    """(config, overrides) of every config in extension.yaml that needs no download and no host."""
    found = []
    for config in yaml.safe_load((root / "extension.yaml").read_text())["configs"]:
        needs = set(config["needs"])
        if needs - {"capture"} or (needs and not capture):
            continue
        given = [f"data.source={capture}"] if needs else []
        found.append((config["path"], SMALL.get(config["path"], RUN) + given))
    found += [("configs/closed-form.yaml", RUN + more) for more in MORE]
    if capture:
        found.append(("configs/closed-form.yaml", [*RUN, f"data.source={capture}", "system.gs_source=?fit"]))
    return found


def values(folder: Path) -> dict[str, object]:
    """What a run left: a digest of each PLY and each file of weights, and the rows of error.csv without times."""
    left: dict[str, object] = {}
    for file in sorted([*folder.rglob("save/*.ply"), *folder.rglob("save/**/*.safetensors")]):
        left[file.name] = hashlib.sha256(file.read_bytes()).hexdigest()
    for file in folder.rglob("error.csv"):
        with file.open() as lines:
            rows = [{k: v for k, v in row.items() if not k.startswith(TIMED)} for row in csv.DictReader(lines)]
        left["error.csv"] = rows
    return left


def run(root: Path, python: str, config: str, overrides: list[str], folder: Path) -> dict[str, object]:
    """The results of one config. Raises RuntimeError with the end of what it printed where it fails."""
    command = [python, "launch.py", "--config", config, *overrides, f"exp_root_dir={folder}"]
    command += ["use_timestamp=false", "trainer.accelerator=cpu"]
    if config == "configs/prior.yaml":
        command.append(f"data.pairs={folder}/pairs")
    threads = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    done = subprocess.run(
        command, cwd=root, env={**os.environ, **threads}, capture_output=True, text=True, stdin=subprocess.DEVNULL
    )
    if done.returncode:
        raise RuntimeError(f"{config}: {done.stderr[-1500:]}")
    return values(folder)


def measure(root: Path, python: str, job: tuple[str, list[str]], fitted: Path | None) -> tuple[str, dict[str, object]]:
    """A config's name and results, of its second run."""
    config, overrides = job
    name = " ".join([config, *(o for o in overrides if o not in RUN and not o.startswith("data.source"))])
    if any(o.endswith("=?fit") for o in overrides):
        name, overrides = f"{config} on the capture", [o.replace("?fit", str(fitted)) for o in overrides]
    for _ in range(2):
        with tempfile.TemporaryDirectory() as folder:
            result = run(root, python, config, overrides, Path(folder))
    return name, result


def differences(before: dict, after: dict) -> list[str]:
    """What differs, a line each."""
    lines = [f"{name}: ran before, not now" for name in before.keys() - after.keys()]
    lines += [f"{name}: new" for name in after.keys() - before.keys()]
    for name in sorted(before.keys() & after.keys()):
        old, new = before[name], after[name]
        for file in sorted(old.keys() | new.keys()):
            if old.get(file) == new.get(file):
                continue
            if file == "error.csv" and old.get(file) and new.get(file):
                columns = {k for rows in (old[file], new[file]) for row in rows for k in row}
                other = [c for c in sorted(columns) if [r.get(c) for r in old[file]] != [r.get(c) for r in new[file]]]
                lines.append(f"{name}: error.csv differs in {', '.join(other)}")
            else:
                lines.append(f"{name}: {file}: {old.get(file)} -> {new.get(file)}")
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, default=ROOT, help="the checkout that is run")
    parser.add_argument("--python", default=sys.executable, help="the interpreter that runs it")
    parser.add_argument("--capture", default="", help="a capture folder, for configs that need one")
    parser.add_argument("--write", type=Path, help="where the results are kept")
    parser.add_argument("--against", type=Path, help="results to compare with")
    args = parser.parse_args()
    capture = str(Path(args.capture).resolve()) if args.capture else ""
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(2) as pool:
        fitted = None
        if capture:
            for name in ("compiles", "kept"):
                run(args.root, args.python, "configs/fit.yaml", [*RUN, f"data.source={capture}"], Path(folder) / name)
            fitted = next((Path(folder) / "kept").rglob("save/last.ply"))
        jobs = runs(args.root, capture)
        results = dict(pool.map(lambda job: measure(args.root, args.python, job, fitted), jobs))
    for name, result in results.items():
        rows = len(result.get("error.csv", []))
        print(f"{name}: {', '.join(f'{k} {v[:12]}' for k, v in result.items() if k != 'error.csv')}, {rows} rows")
    if args.write:
        args.write.write_text(json.dumps(results, indent=1))
    if not args.against:
        return 0
    lines = differences(json.loads(args.against.read_text()), results)
    print("\n".join(lines) if lines else f"the same: {len(results)} runs")
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main())
