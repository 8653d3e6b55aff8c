"""Drift from the anchor and oscillation about it, of both forms of the anchor's pull: as a loss that Adam sees, and as
a proximal step of its own after Adam's.

A few hundred splats of the made statue are edited (warmer all over, a bigger head) by gradients as noisy as those of
score distillation: in each step the target of one view gets fresh noise. Rates are constant, so that what still moves
at the end is oscillation and not schedule. Three questions: what each weight does; what is left of the edit, and how
still it stands, where both forms drift equally far; and whether a loss of another size (a sum instead of a mean) makes
another thing of a weight. Takes about a minute.

python benchmarks/anchors.py
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "custom")]

import numpy as np  # noqa: E402
import torch  # noqa: E402
from dreamcatalyst.data.camera import Cameras, look_at  # noqa: E402
from dreamcatalyst.demo.worlds import PARTS, bear_statue  # noqa: E402
from dreamcatalyst.loss.anchor import FORMS, GROUPS, AnchorConfig, anchor_loss, anchor_step  # noqa: E402
from dreamcatalyst.render.api import rasterize  # noqa: E402
from dreamcatalyst.report.metrics import psnr  # noqa: E402
from dreamcatalyst.scene.gaussians import Gaussians  # noqa: E402
from dreamcatalyst.scene.trainable import Splats  # noqa: E402
from dreamcatalyst.train.optim import LearningRates  # noqa: E402

SIZE, VIEWS, EXTENT = 64, 6, 3.3
WEIGHTS = (1.0, 1e2, 1e4)  # of the first table
BETWEEN = {"loss": (1e-4, 1e-3, 1e-2, 1e-1), "proximal": (1.0, 3.0, 10.0, 30.0)}  # for equal drift
EQUAL = (0.5, 0.25)  # drifts, as shares of the drift without anchor
SUM = 1e4  # about the latents' numbers of a 512 x 512 image: what a sum over them is to their mean
RATES = LearningRates(sh0=1.25e-2, means_decay=1.0).at(0, 1, EXTENT)  # GaussianEditor's


@dataclass(frozen=True)
class Outcome:
    """What one run ends in; the last three are of the last quarter of its steps, means over the groups of parameters.

    drift: rms offset from the anchor by group, raw units. psnr: against the noiseless edit, dB. ms: of the pull alone,
    per step. jumps: rms of one step's movement, in learning rates. turns: share of the steps that go back on the one
    before. wander: standard deviation of a number about its own mean, in learning rates.
    """

    drift: dict[str, float]
    psnr: float
    ms: float
    jumps: float
    turns: float
    wander: float

    def share(self, free: Outcome) -> dict[str, float]:
        """Drift by group, as a share of what it is without anchor."""
        return {group: self.drift[group] / free.drift[group] for group in GROUPS}

    def mean_share(self, free: Outcome) -> float:
        """The mean of `share` over the groups."""
        return sum(self.share(free).values()) / len(GROUPS)


def ring() -> Cameras:
    """Views from all around."""
    angle = torch.arange(VIEWS) * (2 * torch.pi / VIEWS)
    eyes = torch.stack([3 * angle.cos(), 3 * angle.sin(), torch.full_like(angle, 1.2)], dim=-1)
    poses = look_at(eyes, torch.tensor([0.05, 0.0, 0.5]), torch.tensor([0.0, 0.0, 1.0]))
    K = torch.tensor([[1.6 * SIZE, 0, SIZE / 2], [0, 1.6 * SIZE, SIZE / 2], [0, 0, 1]]).expand(VIEWS, 3, 3)
    return Cameras(poses, K.clone(), SIZE, SIZE)


def edited(scene: Gaussians) -> Gaussians:
    """Warmer, and with a head of one and a half times its size."""
    head = scene.extra["part"] == PARTS.index("head")
    center = scene.means[head].mean(0)
    means, log_scales = scene.means.clone(), scene.log_scales.clone()
    means[head] = center + 1.5 * (means[head] - center)
    log_scales[head] += torch.tensor(1.5).log()
    sh0 = scene.sh0 * 0.8 + scene.sh0.new_tensor([0.6, 0.0, -0.6])
    return Gaussians(means, scene.quats, log_scales, scene.logit_opacities, sh0, scene.shN)


def numbers(splats: Splats) -> dict[str, torch.Tensor]:
    """A copy of the parameters by group, one flat tensor each, every number in units of its learning rate."""
    return {
        group: torch.cat([(splats.parameters[name].detach() / RATES[name]).flatten() for name in names])
        for group, names in GROUPS.items()
    }


def offsets(splats: Splats, source: Gaussians) -> dict[str, float]:
    """Rms offset from the source by group, raw units."""
    return {
        group: torch.cat([(splats.parameters[name].detach() - getattr(source, name)).flatten() for name in names])
        .square()
        .mean()
        .sqrt()
        .item()
        for group, names in GROUPS.items()
    }


def run(
    config: AnchorConfig,
    source: Gaussians,
    cameras: Cameras,
    targets: torch.Tensor,
    steps: int,
    noise: float,
    scale: float = 1.0,
) -> Outcome:
    """Edit `source` towards `targets` [V,H,W,3] under this pull. scale: what the edit's own loss is multiplied by."""
    splats, generations = Splats(source), config.generations()
    if generations is not None:
        generations.begin(splats)
    optimizer = splats.make_optimizer(RATES)
    draw = torch.Generator().manual_seed(1)
    before, moves, places, seconds = numbers(splats), [], [], 0.0
    for step in range(steps):
        view = step % VIEWS
        render = rasterize(splats.scene, cameras[[view]])
        wanted = targets[view] + noise * torch.randn(targets[view].shape, generator=draw)
        loss = scale * 0.5 * (render.rgb[0] - wanted).square().mean()
        optimizer.zero_grad()
        started = time.perf_counter()
        pull = anchor_loss(splats, generations, config)
        if pull.requires_grad:
            pull.backward()
        seconds += time.perf_counter() - started
        loss.backward()
        optimizer.step()
        started = time.perf_counter()
        anchor_step(splats, generations, config)
        seconds += time.perf_counter() - started
        after = numbers(splats)
        if step >= steps - steps // 4:
            moves.append({group: after[group] - before[group] for group in GROUPS})
            places.append(after)
        before = after
    made = rasterize(splats.scene.detach(), cameras).rgb

    def over_groups(measure) -> float:
        return sum(measure(group) for group in GROUPS) / len(GROUPS)

    moved = {group: torch.stack([m[group] for m in moves]) for group in GROUPS}
    return Outcome(
        drift=offsets(splats, source),
        psnr=float(psnr(made.clamp(0, 1), targets.clamp(0, 1)).mean()),
        jumps=over_groups(lambda g: moved[g].square().mean().sqrt().item()),
        turns=over_groups(lambda g: (moved[g][1:] * moved[g][:-1] < 0).float().mean().item()),
        wander=over_groups(lambda g: torch.stack([p[g] for p in places]).std(0).square().mean().sqrt().item()),
        ms=1e3 * seconds / steps,
    )


def at_equal_drift(outcomes: list[Outcome], free: Outcome, share: float) -> tuple[float, float, float]:
    """PSNR, jumps and wander of one form where it drifts `share` as far as without anchor, between its weights."""
    known = sorted([*outcomes, free], key=lambda got: got.mean_share(free))
    drifts = np.log([got.mean_share(free) for got in known])
    columns = ([getattr(got, name) for got in known] for name in ("psnr", "jumps", "wander"))
    return tuple(float(np.interp(np.log(share), drifts, column)) for column in columns)


def print_weights(rows: list[tuple[str, float, Outcome]], free: Outcome) -> None:
    """What each weight does."""
    print(f"\n| form | weight | drift, % | {', % | '.join(GROUPS)}, % | PSNR, dB | jumps | turns, % | wander | ms |")
    print("|---|" + "---:|" * (7 + len(GROUPS)))
    for form, weight, got in rows:
        each = " | ".join(f"{100 * share:.1f}" for share in got.share(free).values())
        print(
            f"| {form} | {weight:g} | {100 * got.mean_share(free):.1f} | {each} | {got.psnr:.1f} | {got.jumps:.3f} | "
            f"{100 * got.turns:.0f} | {got.wander:.2f} | {got.ms:.2f} |"
        )


def print_equal(outcomes: dict[str, list[Outcome]], free: Outcome) -> str:
    """What is left of the edit at equal drift. Returns the form that is ahead in all of it, "" where none is."""
    print("\n| drift, % | form | PSNR, dB | jumps | wander |\n|---:|---|---:|---:|---:|")
    ahead = []
    for share in EQUAL:
        got = {form: at_equal_drift(outcomes[form], free, share) for form in FORMS}
        for form, (edit, jumps, wander) in got.items():
            print(f"| {100 * share:.0f} | {form} | {edit:.1f} | {jumps:.3f} | {wander:.2f} |")
        ahead += [max(FORMS, key=lambda form: got[form][0]), *(min(FORMS, key=lambda f: got[f][k]) for k in (1, 2))]
    return ahead[0] if len(set(ahead)) == 1 else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--noise", type=float, default=0.5, help="standard deviation of a target's pixel in each step")
    options = parser.parse_args()
    source, cameras = bear_statue(0, spacing=0.09), ring()
    with torch.no_grad():
        targets = rasterize(edited(source), cameras).rgb
        unedited = float(psnr(rasterize(source, cameras).rgb.clamp(0, 1), targets.clamp(0, 1)).mean())
    print(f"{len(source)} splats, {VIEWS} views of {SIZE} x {SIZE}, {options.steps} steps; unedited: {unedited:.1f} dB")

    def outcome(form: str = "loss", weight: float = 0.0, scale: float = 1.0) -> Outcome:
        weights = dict(weight_init_g0=weight, weight_init=weight, max_weight=weight)
        lambdas = {f"lambda_{group}": 1.0 for group in GROUPS}
        config = AnchorConfig(kind="source", form=form, proximal_rate=1e-3, **weights, **lambdas)
        return run(config, source, cameras, targets, options.steps, options.noise, scale)

    free = outcome()
    made = {form: {w: outcome(form, w) for w in sorted({*WEIGHTS, *BETWEEN[form]})} for form in FORMS}
    print_weights([("none", 0.0, free), *((form, w, made[form][w]) for form in FORMS for w in WEIGHTS)], free)
    ahead = print_equal({form: list(by_weight.values()) for form, by_weight in made.items()}, free)

    print(f"\n| form, weight | drift, % | drift, %, edit's loss x {SUM:g} |\n|---|---:|---:|")
    for form, weight in (("loss", 1e-2), ("proximal", 10.0)):
        shares = [made[form][weight].mean_share(free), outcome(form, weight, SUM).mean_share(outcome(scale=SUM))]
        print(f"| {form}, {weight:g} | " + " | ".join(f"{100 * share:.1f}" for share in shares) + " |")
    print(f"\nahead at equal drift in PSNR, jumps and wander: {ahead or 'neither'}; default: {AnchorConfig().form}")


if __name__ == "__main__":
    main()
