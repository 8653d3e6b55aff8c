"""Density control as sampling: splats that have died are moved to where others are, and faint ones are shaken a little.

Source: Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo"; numbers are those of the paper. The
decisions go by opacity alone: no gradient on the screen is looked at.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..config import Fraction, NonNegative
from ..diffusion.noise import keyed_generator
from ..errors import SceneError
from ..scene.gaussians import Gaussians
from ..scene.trainable import UPDATE, Splats
from .density import Density, Moment

MOST = 51  # copies that stand in one place at most (the paper's code)
SHARPNESS, ALMOST_DEAD = 100.0, 0.005  # of the sigmoid that keeps opaque splats from being shaken (the paper's code)


def relocated(
    opacities: Float[Tensor, " M"], scales: Float[Tensor, "M 3"], copies: Int[Tensor, " M"]
) -> tuple[Float[Tensor, " M"], Float[Tensor, "M 3"]]:
    """Opacity and scales with which `copies` splats in one place look as the one that stood there, equation 9.

    opacities in (0,1); copies 1 or more. The peak of the composite is kept to the digit, and the area under it.
    """
    wide = opacities.double()
    new = 1 - (1 - wide) ** (1 / copies.double())
    area = torch.zeros_like(wide)
    for i in range(1, int(copies.max()) + 1 if len(copies) else 1):
        signed = torch.ones_like(wide)  # of (-1)^k binom(i - 1, k)
        for k in range(i):
            area += torch.where(copies >= i, signed * new ** (k + 1) / (k + 1) ** 0.5, 0.0)
            signed = signed * -(i - 1 - k) / (k + 1)
    return new.to(opacities), scales * (wide / area).to(scales)[:, None]


class Mcmc(Density):
    """Relocation, growth by a fraction up to max_splats, noise on the means and two regularisers.

    Of DensifyConfig, `every`, `start`, `stop`, `min_opacity` and `max_splats` count; the rest is of adaptive control.
    """

    @dataclass(frozen=True)
    class Config:
        growth: Fraction = 0.05  # more splats each time
        noise: NonNegative = 5e5  # of the means, times their learning rate and their covariance
        opacity_weight: NonNegative = 0.01  # of the mean opacity in the loss
        scale_weight: NonNegative = 0.01  # of the mean scale in the loss

    options: Config

    def terms(self, splats: Splats) -> dict[str, Tensor]:
        weights, scene = self.options, splats.edited
        found = {"opacities": weights.opacity_weight * scene.opacities.mean()} if weights.opacity_weight else {}
        return found | ({"scales": weights.scale_weight * scene.scales.mean()} if weights.scale_weight else {})

    def after_step(self, splats: Splats, moment: Moment) -> None:
        super().after_step(splats, moment)
        if self.options.noise and splats.optimizer is not None and moment.step < moment.max_steps:
            self.shake(splats, moment)

    @torch.no_grad()
    def shake(self, splats: Splats, moment: Moment) -> None:
        """The noise of stochastic gradient Langevin dynamics, equation 8: along each splat's own axes, for faint ones.
        A function of seed and step, drawn on the CPU."""
        means, scene = splats.parameters["means"], splats.edited
        (rate,) = (group["lr"] for group in splats.optimizer.param_groups if group["name"] == "means")
        drawn = torch.randn(means.shape, generator=keyed_generator(moment.seed, "langevin", moment.step))
        faint = torch.sigmoid(-SHARPNESS * (scene.opacities - ALMOST_DEAD))
        step = _covary(scene, drawn.to(means)) * (self.options.noise * rate * faint)[:, None]
        share = splats.state.get(UPDATE)
        means += step if share is None else step * share.to(means)[:, None]

    @torch.no_grad()
    def densify(self, splats: Splats, moment: Moment) -> None:
        scene = splats.edited.detach()
        alive = (scene.opacities > self.config.min_opacity).nonzero()[:, 0]
        dead = len(scene) - len(alive)
        if len(alive) == 0:
            if splats.frozen is None:
                raise SceneError("density control: every splat is fainter than system.densify.min_opacity; lower it")
            return
        cap = max(self.config.max_splats, len(scene))
        new = dead + min(int(self.options.growth * len(scene)), cap - len(scene))
        generator = keyed_generator(moment.seed, "relocate", moment.step)
        chances = scene.opacities[alive].double().cpu()
        drawn = torch.multinomial(chances, new, replacement=True, generator=generator) if new else torch.zeros(0).long()
        times = torch.bincount(drawn, minlength=len(alive)).clamp(max=MOST - 1).to(alive.device)
        chosen = times > 0  # all copies are children, the one that stays, too: moments begin anew
        origins, copies = alive[chosen], times[chosen] + 1
        opacities, scales = relocated(scene.opacities[origins], scene.scales[origins], copies)
        opacities = opacities.clamp(self.config.min_opacity, 1 - torch.finfo(opacities.dtype).eps)
        rows = torch.arange(len(origins), device=origins.device).repeat_interleave(copies)
        parents = origins[rows]
        changed = {"logit_opacities": torch.logit(opacities)[rows], "log_scales": scales.log()[rows]}
        if moment.generations is not None:
            changed |= moment.generations.newborn(splats, parents, changed)
        splats.rearrange(alive[~chosen], parents, changed)
        if moment.generations is not None:
            moment.generations.advance(splats)


def _covary(scene: Gaussians, vectors: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """The covariance of each splat times its vector."""
    q = torch.nn.functional.normalize(scene.quats, dim=-1)
    inverse = q * q.new_tensor([1.0, -1, -1, -1])
    return _rotate(q, _rotate(inverse, vectors) * scene.scales.square())


def _rotate(q: Float[Tensor, "N 4"], vectors: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Vectors turned by unit quaternions, wxyz."""
    uv = torch.linalg.cross(q[:, 1:], vectors)
    return vectors + 2 * (q[:, :1] * uv + torch.linalg.cross(q[:, 1:], uv))
