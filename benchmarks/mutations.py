"""Mistakes, planted one at a time in a copy of the tree, that its tests must see: python benchmarks/mutations.py

First all tests that are to see something run without a mutation: what fails then says nothing, and is left out. Prints,
for each mutation, the tests that fail; the exit status is 1 where one is not seen. --only takes some by words
of their names, --tree another checkout (of an earlier commit, say), --whole runs all tests of the tree, to their end.
"""

from __future__ import annotations

import argparse
import difflib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LEFT_OUT = (".git", ".venv", "outputs", "build", "benchmarks/precision", ".cache")
PACKAGE = "custom/dreamcatalyst"


@dataclass(frozen=True)
class Mutation:
    """`old`, which stands in one place of the package whatever its file is called, becomes `new`; `tests`: names of the
    files that must see it, wherever they lie."""

    name: str
    old: str
    new: str
    tests: tuple[str, ...]


MUTATIONS = [
    Mutation(
        "a sign in the rule's gradient", "gradient += b * (x - x_src)", "gradient -= b * (x - x_src)", ("test_distill",)
    ),
    Mutation(
        "text in the reference branch on the source",
        "Branch(add_noise(x_src, noise, abar), None, edit.image, *scales)",
        "Branch(add_noise(x_src, noise, abar), edit.text, edit.image, *scales)",
        ("test_distill",),
    ),
    Mutation(
        "noise that is not keyed by the step",
        'keyed_generator(seed, "noise", step, view)',
        'keyed_generator(seed, "noise", view)',
        ("test_noise",),
    ),
    Mutation(
        "a mask that is not inverted",
        "weights, chosen = 1 - weights, masks.invert(chosen)",
        "weights, chosen = weights, chosen",
        ("test_segmenters",),
    ),
    Mutation(
        "a kept mask with inside and outside swapped",
        "mask, inside, outside)",
        "mask, outside, inside)",
        ("test_confined",),
    ),
    Mutation(
        "a feathered update with both ends swapped",
        "torch.lerp(before[name], value[rows], weight)",
        "torch.lerp(value[rows], before[name], weight)",
        ("test_splats", "test_confined"),
    ),
    Mutation(
        "a resume that forgets Adam's moments",
        'self.record.load_state_dict(checkpoint["run"])',
        'self.record.load_state_dict(checkpoint["run"]); checkpoint["optimizer_states"][0]["state"] = {}',
        ("test_runs", "test_in2n_resume"),
    ),
    Mutation(
        "SH of a degree too low", "y = basis(dirs, degree)", "y = basis(dirs, degree - 1)", ("test_backends_agree",)
    ),
    Mutation(
        "the principal point of a crop half a pixel off",
        "shift[:, 0, 2], shift[:, 1, 2] = left, top",
        "shift[:, 0, 2], shift[:, 1, 2] = left + 0.5, top + 0.5",
        ("test_views",),
    ),
    Mutation(
        "pixels taken at their corner",
        "x = torch.arange(cameras.width).to(means2d) + 0.5",
        "x = torch.arange(cameras.width).to(means2d)",
        ("test_reference",),
    ),
    Mutation(
        "an opacity reset that keeps the moments",
        "splats.optimizer.state[logits][key] = torch.zeros_like(value)",
        "splats.optimizer.state[logits][key] = value",
        ("test_densify",),
    ),
    Mutation(
        "statistics of density control that go on",
        "    splats.state.update(screen_statistics(splats))\n    return DensifyReport",
        "    return DensifyReport",
        ("test_densify",),
    ),
    Mutation(
        "children with the moments of their parents",
        "value.new_zeros(len(parents), *value.shape[1:])",
        "value[parents]",
        ("test_splats", "test_densify"),
    ),
    Mutation(
        "quaternions of a PLY as xyzw",
        "scene.quats.float().numpy()",
        "scene.quats.float().roll(-1, dims=1).numpy()",
        ("test_ply",),
    ),
    Mutation("PSNR twice as large", "-10 * torch.log10(mean)", "-20 * torch.log10(mean)", ("test_reports",)),
    Mutation(
        "a file written in place",
        "            part.replace(path)\n",
        "            path.write_bytes(part.read_bytes())\n",
        ("test_files",),
    ),
]


def place(tree: Path, text: str) -> Path:
    """The file of the package that holds `text`. Raises LookupError, with the nearest line, unless it is there once."""
    sources = {path: path.read_text(encoding="utf-8") for path in sorted((tree / PACKAGE).rglob("*.py"))}
    found = [path for path, source in sources.items() for _ in range(source.count(text))]
    if len(found) == 1:
        return found[0]
    wanted = max(text.strip().splitlines(), key=len).strip()
    lines = [
        (line.strip(), f"{path.relative_to(tree)}:{number}")
        for path, source in sources.items()
        for number, line in enumerate(source.splitlines(), start=1)
    ]
    close = difflib.get_close_matches(wanted, [line for line, _ in lines], n=1, cutoff=0.0)[0]
    where = next(where for line, where in lines if line == close)
    raise LookupError(
        f"{tree}: expected once in {PACKAGE}: {text.strip()!r}, got {len(found)} places. The nearest line is "
        f"{where}: {close!r}. Give the mutation the text that is there now."
    )


def test_files(tree: Path, names: tuple[str, ...]) -> list[str]:
    """Paths of test files, from the tree. Raises LookupError where there is none of a name."""
    out = []
    for name in names:
        found = sorted((tree / "tests").rglob(f"{name}.py"))
        if not found:
            known = {path.stem for path in (tree / "tests").rglob("test_*.py")}
            close = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
            raise LookupError(f"{tree}: no tests/**/{name}.py. The nearest name is {close}.")
        out += [str(path.relative_to(tree)) for path in found]
    return out


def copy_of(tree: Path, folder: Path) -> Path:
    """The tree with its times, so that kernels that are compiled already stay valid."""
    left_out = {str(tree / name) for name in LEFT_OUT}

    def ignore(where: str, names: list[str]) -> list[str]:
        return [name for name in names if f"{where}/{name}" in left_out]

    return Path(shutil.copytree(tree, folder, ignore=ignore, symlinks=True))


def failures(tree: Path, mutation: Mutation | None, asked: list[str], left_out: list[str]) -> list[str]:
    """Tests that fail with the mutation, or without any. asked: what pytest is to run; left_out: tests that are not to.
    Raises LookupError for a text that is not there, RuntimeError where the tests did not run."""
    with tempfile.TemporaryDirectory(prefix="mutation-") as temporary:
        copy = copy_of(tree, Path(temporary) / "tree")
        (Path(temporary) / "shared").symlink_to(tree.parent / "shared")  # captures, for the tests that have some
        if mutation is not None:
            file = place(copy, mutation.old)
            file.write_text(file.read_text(encoding="utf-8").replace(mutation.old, mutation.new), encoding="utf-8")
        one = {name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")}
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            "-o",
            "addopts=--import-mode=importlib",
        ]
        command += [f"--deselect={name}" for name in left_out]
        done = subprocess.run([*command, *asked], cwd=copy, capture_output=True, text=True, env=os.environ | one)
    found = re.findall(r"^(?:FAILED|ERROR) (\S+)", done.stdout, flags=re.MULTILINE)
    if done.returncode not in (0, 1) and not found:
        what = mutation.name if mutation else "no mutation"
        end = f"{done.stdout[-2000:]}{done.stderr[-2000:]}"
        raise RuntimeError(f"{what}: pytest ended with {done.returncode}:\n{end}")
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="WORD", help="mutations whose name holds one of these words")
    parser.add_argument("--tree", type=Path, default=ROOT, help="the checkout that is copied")
    parser.add_argument("--whole", action="store_true", help="run all tests with each mutation")
    parser.add_argument("--jobs", type=int, default=1, help="mutations that are tried at a time")
    args = parser.parse_args()
    chosen = [m for m in MUTATIONS if not args.only or any(word in m.name for word in args.only)]
    tree = args.tree.resolve()
    asked = {}
    for mutation in chosen:
        place(tree, mutation.old)
        asked[mutation] = [] if args.whole else ["-x", *test_files(tree, mutation.tests)]
    every = sorted({name for names in asked.values() for name in names if name != "-x"})
    already = failures(tree, None, every, [])
    if already:
        print(f"fail without a mutation, and are left out: {', '.join(already)}\n")
    print("| mutation | tests that fail |\n|---|---|", flush=True)
    unseen = 0
    with ThreadPoolExecutor(args.jobs) as pool:
        for mutation, found in zip(
            chosen, pool.map(lambda m: failures(tree, m, asked[m], already), chosen), strict=True
        ):
            print(f"| {mutation.name} | {', '.join(found) or 'NONE'} |", flush=True)
            unseen += not found
    print(f"\n{len(chosen)} mutations: {len(chosen) - unseen} seen, {unseen} not")
    return int(unseen > 0)


if __name__ == "__main__":
    sys.exit(main())
