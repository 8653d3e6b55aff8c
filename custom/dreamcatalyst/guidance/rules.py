"""Every score-distillation rule as one row of a table.

The gradient on the latents is g = a(t) (eps_edit - eps_ref) + b(t) (x - x_src), with no gradient through the network.
A new rule is one row more, here or in a file of one's own that a run's config imports: `RULES.add(name, Rule(...))`.
What delivers pictures in the place of a gradient is a `Replacement` in the same registry.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..diffusion.noise import abar_at
from ..errors import ConfigError, choose
from ..registry import Registry

# What eps_ref is: the injected noise; the source latents with the source text; the source latents without text;
# the edited latents without text.
NOISE, SOURCE, SOURCE_NULL, EDIT_NULL = "noise", "source", "source-null", "edit-null"


@dataclass(frozen=True)
class Parameters:
    """The free numbers of the weights. chi, delta, gamma: DreamCatalyst, equation 18; gap: PDS, in timesteps."""

    chi: float = 0.075  # identity: b = chi e^u
    delta: float = 0.2  # editing: a = delta + gamma u^(1/e)
    gamma: float = 0.8
    gap: int = 2  # from t to the earlier step of PDS: 2 as published (500 of 1000 steps), 1 is the single step
    implicit_step: float = 0.0  # length h of a step on latents that takes the identity term implicitly; 0: explicitly


PRESETS: dict[str, Parameters] = {
    "paper": Parameters(),  # "for all experiments": the default, because it is what the paper states and derives
    "published-3dgs": Parameters(delta=0.05, gamma=0.2),  # what the published 3DGS code is run with: a quarter of a(t)
}

Weight = Callable[[Parameters, int, Float[Tensor, " T"]], float]


def noise_level(timestep: int, train_steps: int) -> float:
    """u = (t - 1) / T in [0,1): the paper's t/T as its code computes it.

    The code numbers 500 DDIM steps i, with t = 2 i + 1 of T = 1000 and u = i / 500; solved for t this is (t - 1) / T,
    which makes u a function of the timestep alone: 0.9 at t = 901, 0.2 at t = 201.
    """
    return max(timestep - 1, 0) / train_steps


def pds_coefficients(alphas_cumprod: Float[Tensor, " T"], timestep: int, gap: int = 2) -> tuple[float, float]:
    """(Phi, Psi) of Posterior Distillation Sampling (Koo et al. 2024) at index `timestep`.

    z_t(x_tgt) - z_t(x_src) = Phi (x - x_src) + Psi (eps_edit - eps_ref), where alpha_t and beta_t are those of the
    single step t-1 -> t and the earlier step is p = t - gap. At gap 1 Phi is exactly zero: PDS has an identity term
    only because its published code takes steps of two. Raises ConfigError where abar_p is 1 (sigma would be zero), and
    where abar_t is 0 (Psi would be infinite).
    """
    abar = torch.cat([torch.ones(1, dtype=torch.float64), alphas_cumprod.double()])
    phi, psi = pds_coefficients_from_betas(1.0 - abar[1:] / abar[:-1], timestep, gap)
    return float(phi), float(psi)


def pds_coefficients_from_betas(
    betas: Float[Tensor, " T"], timestep: int, gap: int = 2
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """The same from beta_t, in the precision of `betas`: written without cancellation, so that float32 will do.

    With q = abar_{t-1} / abar_p:  Phi = alpha_t sqrt(abar_p) (1 - sqrt q) (1 + abar_p sqrt q) / ((1 - abar_t) sigma_t),
    sigma_t^2 = beta_t (1 - abar_p) / (1 - abar_t);  Psi = sqrt(abar_p) beta_t / sqrt(abar_t (1 - abar_t)) / sigma_t.
    Every 1 - product is taken from the sum of its logarithms.
    """
    if gap < 1:
        raise ConfigError(f"system.guidance.gap: got {gap}, expected at least 1 timestep")
    earlier = timestep - gap
    if not 0 <= timestep < len(betas):
        raise ConfigError(f"pds: timestep {timestep} is outside the prior's schedule: 0..{len(betas) - 1}.")
    log_alpha = torch.log1p(-betas)
    log_p = log_alpha[: max(earlier + 1, 0)].sum()
    if log_p >= 0.0:
        raise ConfigError(
            f"system.guidance.timesteps: at timestep {timestep} the earlier step {earlier} of PDS is noiseless "
            f"(abar = 1), and PDS divides by zero. Keep timesteps from {gap} up: raise min_step_percent."
        )
    log_q = log_alpha[earlier + 1 : timestep].sum()
    log_t = log_alpha[: timestep + 1].sum()
    if torch.isneginf(log_t):
        raise ConfigError(
            f"system.guidance.timesteps: timestep {timestep} holds no signal (abar = 0: zero terminal SNR), and PDS "
            "divides by it. Stay below it: lower max_step_percent."
        )
    beta, abar_p, sqrt_q = betas[timestep], torch.exp(log_p), torch.exp(0.5 * log_q)
    one_minus_p, one_minus_t = -torch.expm1(log_p), -torch.expm1(log_t)
    sigma = torch.sqrt(beta * one_minus_p / one_minus_t)
    phi = (1.0 - beta) * torch.exp(0.5 * log_p) * -torch.expm1(0.5 * log_q) * (1.0 + abar_p * sqrt_q)
    psi = torch.exp(0.5 * (log_p - log_t)) * beta / torch.sqrt(one_minus_t)
    return phi / (one_minus_t * sigma), psi / sigma


def _zero(p: Parameters, t: int, abar: Float[Tensor, " T"]) -> float:
    return 0.0


def _one(p: Parameters, t: int, abar: Float[Tensor, " T"]) -> float:
    return 1.0


def _noise_variance(p: Parameters, t: int, abar: Float[Tensor, " T"]) -> float:
    return 1.0 - abar_at(abar, t)


def _psi1(p: Parameters, t: int, abar: Float[Tensor, " T"]) -> float:
    return p.delta + p.gamma * noise_level(t, len(abar)) ** (1.0 / math.e)


def _psi3(p: Parameters, t: int, abar: Float[Tensor, " T"]) -> float:
    return 1.0 - 0.2 * noise_level(t, len(abar))


def _phi(p: Parameters, t: int, abar: Float[Tensor, " T"]) -> float:
    return p.chi * math.exp(noise_level(t, len(abar)))


def _pds_phi(p: Parameters, t: int, abar: Float[Tensor, " T"]) -> float:
    return pds_coefficients(abar, t, p.gap)[0]


def _pds_psi(p: Parameters, t: int, abar: Float[Tensor, " T"]) -> float:
    return pds_coefficients(abar, t, p.gap)[1]


@dataclass(frozen=True)
class Rule:
    """One row: the weights a(t) and b(t), what eps_ref is, and the timestep policy.

    a: on eps_edit - eps_ref. b: on x - x_src. timesteps: default policy (timesteps.py).
    needs_image: it is defined by an image condition, which a text-to-image prior has not.
    """

    name: str
    a: Weight
    b: Weight
    reference: str
    timesteps: str
    citation: str
    needs_image: bool = False
    parameters: Parameters = field(default_factory=Parameters)

    @property
    def reads_source_text(self) -> bool:
        """Whether eps_ref is conditioned on a description of the source."""
        return self.reference == SOURCE

    @property
    def needs_source(self) -> bool:
        """Whether it compares with the source's latents, or with no noise that is known."""
        return self.reference != NOISE

    def weights(self, timestep: int, alphas_cumprod: Float[Tensor, " T"]) -> tuple[float, float]:
        """(a, b) at index `timestep` of a prior with this schedule.

        With an implicit step h, both divided by 1 + h b: x - h g then is the backward Euler step of the identity term,
        x' = x - h [a (eps_edit - eps_ref) + b (x' - x_src)], which no b makes overshoot x_src.
        """
        a, b = self.a(self.parameters, timestep, alphas_cumprod), self.b(self.parameters, timestep, alphas_cumprod)
        damping = 1.0 + self.parameters.implicit_step * b
        return a / damping, b / damping


@dataclass(frozen=True)
class Replacement:
    """A row of the table beside `Rule`. objective(prompted, row): a `Comparison` (guidance/comparison.py).

    needs_image: it is defined by an image condition, which a text-to-image prior has not. needs_exact: it takes a prior
    that knows its edit.
    """

    name: str
    objective: Callable[[Any, Replacement], Any]
    citation: str
    needs_image: bool = False
    needs_exact: bool = False

    reads_source_text = needs_source = False  # no class of ours compares with the source
    timesteps = "uniform"  # how noise levels are drawn where nothing else is said


# Equations are DreamCatalyst's, numbered by the labels of its LaTeX source.
_DC = "DreamCatalyst, Kim et al. 2025 (ICLR), equations 17-18"
_TABLE = (
    Rule("sds", _noise_variance, _zero, NOISE, "uniform", "DreamFusion, Poole et al. 2023; equation 5"),
    Rule("dds", _one, _zero, SOURCE, "uniform", "Delta Denoising Score, Hertz et al. 2023; equation 7"),
    Rule("pds", _pds_psi, _pds_phi, SOURCE, "uniform", "Posterior Distillation Sampling, Koo et al. 2024; equation 10"),
    Rule("dreamcatalyst", _psi1, _phi, SOURCE_NULL, "decreasing", _DC, needs_image=True),
    Rule("dreamcatalyst-psi2", _one, _phi, SOURCE_NULL, "decreasing", f"{_DC}; Psi_2 = 1", needs_image=True),
    Rule("dreamcatalyst-psi3", _psi3, _phi, SOURCE_NULL, "decreasing", f"{_DC}; Psi_3 = 1 - 0.2 t/T", needs_image=True),
    Rule(
        "csd-like", _psi1, _phi, EDIT_NULL, "decreasing", "the 3DGS code published with DreamCatalyst", needs_image=True
    ),
)

RULES = Registry("guidance rule", __package__)
for _row in _TABLE:
    RULES.add(_row.name, _row)
RULES.add("in2n", ".comparison:IN2N")
RULES.add("known-edit", ".comparison:KNOWN_EDIT")


def gradient_rules() -> list[str]:
    """The names of all rules that give a gradient, sorted."""
    return [name for name in RULES.names() if isinstance(RULES.get(name), Rule)]


def get_rule(name: str, preset: str = "paper", **overrides: float) -> Rule | Replacement:
    """The rule `name` with the parameters of `preset`, single ones replaced by `overrides` (chi, delta, gamma, gap,
    implicit_step).

    Raises ConfigError for an unknown rule, preset or parameter, naming the nearest, and for a negative step.
    """
    rule: Rule | Replacement = RULES.get(name, "system.guidance.rule")
    parameters = PRESETS[choose("preset of rule parameters", preset, PRESETS, "system.guidance.preset")]
    known = [f.name for f in fields(Parameters)]
    for key in overrides:
        choose("rule parameter", key, known, "system.guidance")
    if not 0 <= overrides.get("implicit_step", 0.0) < math.inf:
        raise ConfigError(f"system.guidance.implicit_step: got {overrides['implicit_step']}, expected 0 or more.")
    if not isinstance(rule, Rule):  # it has no weights that parameters could set
        return rule
    return replace(rule, parameters=replace(parameters, **overrides))
