"""The paper's two coefficient figures: what PDS and DreamCatalyst give to identity and to editing at every timestep.

    python benchmarks/coefficient_figures.py [--out docs/coefficients.png] [--gap 2]

prints the curves at some timesteps and draws them all in the order in which a run takes them: noise falls to the right.
It needs matplotlib: pip install ".[benchmarks]"
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "custom"))

from dreamcatalyst.diffusion.noise import stable_diffusion_schedule  # noqa: E402
from dreamcatalyst.guidance.rules import get_rule  # noqa: E402

PRINTED = (21, 101, 201, 401, 601, 801, 901, 999)
FIRST = 21  # where the published codes begin: below it Phi of PDS only grows further
EDITING, IDENTITY = 0, 1  # places of a and b in a rule's weights
PANELS = {  # title -> (label, rule, weight, colour, line)
    "PDS: identity outweighs editing at low noise": (
        ("Φ PDS", "pds", IDENTITY, "tab:blue", "-"),
        ("Ψ PDS", "pds", EDITING, "tab:red", "-"),
    ),
    "DreamCatalyst: editing leads throughout": (
        ("Ψ*", "dreamcatalyst", EDITING, "tab:red", "-"),
        ("Ψ*₂", "dreamcatalyst-psi2", EDITING, "tab:red", "--"),
        ("Ψ*₃", "dreamcatalyst-psi3", EDITING, "tab:red", ":"),
        ("Φ*", "dreamcatalyst", IDENTITY, "tab:blue", "-"),
    ),
}


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "coefficients.png")
    parser.add_argument("--gap", type=int, default=2, help="timesteps between the two steps of PDS: 2 as published")
    args = parser.parse_args(argv)

    try:
        import matplotlib
    except ImportError as error:
        sys.exit(f'the figures need matplotlib, which cannot be imported: {error}. Remedy: pip install ".[benchmarks]"')

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    abar = stable_diffusion_schedule()
    figure, axes = plt.subplots(1, len(PANELS), figsize=(9, 3.2), layout="constrained")
    for axis, (title, curves) in zip(axes, PANELS.items(), strict=True):
        print(title, "t".rjust(8) + "".join(label.rjust(10) for label, *_ in curves), sep="\n")
        values = {
            label: [get_rule(rule, gap=args.gap).weights(t, abar)[weight] for t in range(FIRST, len(abar))]
            for label, rule, weight, _, _ in curves
        }
        for t in PRINTED:
            print(f"{t:8d}" + "".join(f"{values[label][t - FIRST]:10.4f}" for label, *_ in curves))
        for label, _, _, colour, line in curves:
            axis.plot(range(FIRST, len(abar)), values[label], line, color=colour, label=label)
        axis.set(title=title, xlabel="timestep t", xlim=(len(abar), 0), yscale="log" if "PDS" in title else "linear")
        axis.legend()
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("weight")
    figure.savefig(args.out, dpi=100)
    print(f"drawn: {args.out}")


if __name__ == "__main__":
    main()
