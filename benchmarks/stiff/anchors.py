"""Anchors that pull as hard as they can: weights up to the cap, of 1e4 and far beyond, as a loss and as a step."""

from __future__ import annotations

from collections.abc import Callable

import torch
from dreamcatalyst.config import parse
from dreamcatalyst.errors import ConfigError
from dreamcatalyst.loss.anchor import AnchorConfig, anchor_loss, anchor_step
from dreamcatalyst.scene.gaussians import PARAMETERS
from dreamcatalyst.scene.trainable import Splats
from torch import Tensor

from .cases import Case, Check, bound, compare, refused, worst
from .splats import cloud

RATE = 1e-2  # of Adam, for all parameters
ADAM = 7.3  # what Adam moves at most in a step, in learning rates: (1-b1) / sqrt((1-b2) (1 - b1^2/b2))


def config(form: str, weight: float, **changes: float) -> AnchorConfig:
    """Anchors at the source of this weight on every parameter."""
    weights = dict(weight_init_g0=weight, weight_init=weight, max_weight=weight)
    lambdas = {f"lambda_{group}": 1.0 for group in ("color", "geo", "opacity", "scale")}
    return AnchorConfig(**{"kind": "source", "form": form, "proximal_rate": 1e-3, **weights, **lambdas, **changes})


def held(options: AnchorConfig, dtype: torch.dtype, rounded: torch.dtype):
    """Splats with anchors where they began, and each parameter a tenth of a unit away from there."""
    scene = cloud().to(dtype=rounded).to(dtype=dtype)
    splats, generations = Splats(scene), options.generations()
    generations.begin(splats)
    g = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for value in splats.parameters.values():
            value += (0.1 * torch.randn(value.shape, generator=g, dtype=torch.float64)).to(rounded).to(dtype)
    return splats, generations


def three_ways(quantity: str, result: Callable[..., dict[str, Tensor]]) -> Check:
    """result(dtype, rounded) of float32 against float64 and float64 of rounded inputs; the worst of what it returns."""
    half, full = torch.float32, torch.float64
    got, truth, rounded = result(half, half), result(full, full), result(full, half)
    return worst(quantity, {name: compare(name, got[name], truth[name], rounded[name]) for name in got})


def pulled(weight: float) -> Callable[[], list[Check]]:
    """A case: the derivative of the loss form."""

    def slopes(dtype: torch.dtype, rounded: torch.dtype) -> dict[str, Tensor]:
        splats, generations = held(config("loss", weight), dtype, rounded)
        anchor_loss(splats, generations, config("loss", weight)).backward()
        return {name: value.grad for name, value in splats.parameters.items()}

    return lambda: [three_ways("gradient", slopes)]


def stepped(weight: float) -> Callable[[], list[Check]]:
    """A case: one step of the proximal form, and that it never leads past the anchor."""

    def after(dtype: torch.dtype, rounded: torch.dtype) -> dict[str, Tensor]:
        splats, generations = held(config("proximal", weight), dtype, rounded)
        anchor_step(splats, generations, config("proximal", weight))
        return {name: value.detach() for name, value in splats.parameters.items()}

    def beyond() -> float:
        splats, generations = held(config("proximal", weight), torch.float64, torch.float64)
        before = {name: value.detach().clone() for name, value in splats.parameters.items()}
        anchor_step(splats, generations, config("proximal", weight))
        anchors = {name: splats.state[f"anchor_{name}"] for name in PARAMETERS}
        turned = [((v - anchors[n]) * (before[n] - anchors[n])).min() for n, v in splats.parameters.items()]
        return max(0.0, -float(torch.stack(turned).detach().min()))

    return lambda: [three_ways("parameters", after), bound("past the anchor", beyond(), 1e-18)]


def descended(form: str, weight: float, steps: int = 100) -> Callable[[], list[Check]]:
    """A case: steps of Adam on nothing but noise and the pull. How far splats are from their anchors in the end, in
    learning rates: of the proximal form at most what Adam moves at most, over c w; of the loss form, where Adam sees
    the pull itself and swings about, no more than one such move."""

    def run() -> list[Check]:
        options = config(form, weight)
        splats, generations = held(options, torch.float32, torch.float32)
        optimizer, g = splats.make_optimizer(dict.fromkeys(PARAMETERS, RATE)), torch.Generator().manual_seed(4)
        for _ in range(steps):
            optimizer.zero_grad()
            noise = [torch.randn(value.shape, generator=g) for value in splats.parameters.values()]
            drift = sum((value * n).sum() for value, n in zip(splats.parameters.values(), noise, strict=True))
            (1e-3 * drift + anchor_loss(splats, generations, options)).backward()
            optimizer.step()
            anchor_step(splats, generations, options)
        offsets = [value.detach() - splats.state[f"anchor_{n}"] for n, value in splats.parameters.items()]
        farthest = float(max(offset.abs().max() for offset in offsets)) / RATE
        limit = ADAM / (options.proximal_rate * weight) if form == "proximal" else ADAM
        return [bound("farthest, learning rates", farthest, limit)]

    return run


def capped(multiplier: float, densifications: int) -> Callable[[], list[Check]]:
    """A case: the weights of all generations, against min(W multiplier^k, cap)."""

    def run() -> list[Check]:
        options = AnchorConfig(kind="source", weight_multiplier=multiplier)
        generations = options.generations()
        splats = Splats(cloud(3))
        generations.begin(splats)
        for _ in range(densifications):
            generations.advance(splats)
        ages = torch.arange(densifications - 2, -1, -1, dtype=torch.float64)  # since a generation got its first weight
        grown = torch.tensor(multiplier, dtype=torch.float64) ** torch.cat([ages.new_tensor([densifications]), ages])
        grown[0] *= options.weight_init_g0
        grown[1:] *= options.weight_init
        truth = torch.cat([grown, grown.new_zeros(1)]).clamp_max(options.max_weight)
        weights = torch.tensor(generations.weights, dtype=torch.float64)
        return [compare("weights", weights, truth, truth)]

    return run


CASES = [
    Case("anchors", name, run)
    for name, run in {
        "multipliers that reach the cap": capped(1.3, 60),
        "a multiplier of 1e300": capped(1e300, 4),
        "weights that never grow": capped(0.0, 5),
        "weight 1e4, loss": pulled(1e4),
        "weight 1e4, proximal": stepped(1e4),
        "weight 1e30, proximal": stepped(1e30),
        "weight 1e-12, proximal": stepped(1e-12),
        "weight 1e4, loss, 100 steps of Adam": descended("loss", 1e4),
        "weight 1e4, proximal, 100 steps of Adam": descended("proximal", 1e4),
        "weights without end": lambda: [
            refused(ConfigError, "weight_init_g0", lambda: parse(AnchorConfig, {"weight_init_g0": float("inf")})),
            refused(ConfigError, "weight_init_g0", lambda: parse(AnchorConfig, {"weight_init_g0": float("nan")})),
        ],
    }.items()
]
