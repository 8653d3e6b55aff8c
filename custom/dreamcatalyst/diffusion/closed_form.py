"""An exact denoiser without weights: every distribution that it is asked about is a Gaussian around a known image.

Derivation and use: docs/closed-form.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, no_type_check

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from ..config import Number, Positive
from ..errors import PriorError
from .api import Prior, Row
from .noise import abar_at, stable_diffusion_schedule
from .operators import Instruction, Operator, find_operator

Form = TypeVar("Form", bound="ClosedForm")


@dataclass(frozen=True)
class ClosedFormConfig:
    """Spreads and means in latent units, [-1,1]."""

    s: Positive = 0.05  # of x_0 given image and instruction, around T(image)
    s_image: Positive | None = None  # of x_0 given the image, around the image; None: solved (guidance/fixed_point.py)
    s_null: Positive | None = None  # of x_0 given nothing, around mu; None: the same as s_image
    mu: Number = 0.0  # mean of x_0 given nothing; it cancels in every rule that has a source branch


class SourceImage:
    """The condition: B images as latents, and what each operator makes of them, computed once."""

    def __init__(self, latents: Float[Tensor, "B 3 H W"]):
        self.latents = latents
        self._edited: dict[str, Tensor] = {}
        self._known: Tensor | None = None

    def assume(self, latents: Float[Tensor, "B 3 H W"]) -> None:
        """Take `latents` for what any instruction makes of the images."""
        self._known = latents

    def edited(self, instruction: Instruction) -> Float[Tensor, "B 3 H W"]:
        """T(image) as latents. Raises PriorError where the instruction says nothing of images."""
        if self._known is not None:
            return self._known
        if not isinstance(instruction, Operator):
            raise PriorError(
                f"'{instruction.name}' names no operation on images, and what it makes of this is not known"
            )
        if instruction.name not in self._edited:
            self._edited[instruction.name] = 2.0 * instruction((self.latents + 1.0) / 2.0) - 1.0
        return self._edited[instruction.name]

    @staticmethod
    def cat(parts: Sequence[SourceImage]) -> SourceImage:
        """One condition of all their images; what each has computed is kept."""
        joined = SourceImage(torch.cat([part.latents for part in parts]))
        for name in set.intersection(*(set(part._edited) for part in parts)):
            joined._edited[name] = torch.cat([part._edited[name] for part in parts])
        known = [part._known for part in parts if part._known is not None]
        if len(known) == len(parts):
            joined._known = torch.cat(known)
        return joined


class ClosedForm(Prior):
    """x_0 | image, y ~ N(T_y(image), s^2); x_0 | image ~ N(image, s_image^2); x_0 ~ N(mu, s_null^2), per element.

    Latents are the pixels themselves, 2 * image - 1. An instruction names an image operator T_y (operators.py).
    Works in the precision of the latents, float64 included.
    """

    Config = ClosedFormConfig
    exact = True

    def __init__(
        self,
        config: ClosedFormConfig | None = None,
        device: torch.device | str = "cpu",
        alphas_cumprod: Float64[Tensor, " T"] | None = None,
    ):
        """device: any, there are no weights to place; alphas_cumprod: Stable Diffusion's where none is given."""
        self.config = config or ClosedFormConfig()
        self.alphas_cumprod = stable_diffusion_schedule() if alphas_cumprod is None else alphas_cumprod

    def encode(
        self, images: Float[Tensor, "B 3 H W"], noise: Float[Tensor, "B 3 H W"] | None = None
    ) -> Float[Tensor, "B 3 H W"]:
        return 2.0 * images - 1.0

    @torch.no_grad()
    def decode(self, latents: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
        return ((latents + 1.0) / 2.0).clamp(0.0, 1.0)

    @torch.no_grad()
    def condition(self, images: Float[Tensor, "B 3 H W"]) -> SourceImage:
        return SourceImage(self.encode(images))

    def stack(self, conditions: Sequence[SourceImage]) -> SourceImage:
        return SourceImage.cat(conditions)

    @torch.no_grad()
    def known_edit(self, condition: SourceImage, text: Instruction | None) -> Float[Tensor, "B 3 H W"]:
        return self.decode(condition.latents if text is None else condition.edited(text))

    def with_spread(self: Form, spread: float) -> Form:
        """The same prior with s_image = s_null = spread."""
        return type(self)(replace(self.config, s_image=spread, s_null=spread), alphas_cumprod=self.alphas_cumprod)

    def embed(self, prompts: Sequence[str]) -> list[Operator | None]:
        """The operator that each instruction names; None, the identity, for an empty one."""
        return [find_operator(prompt) for prompt in prompts]

    def spreads(self) -> tuple[float, float, float]:
        """(s, s_image, s_null). Raises PriorError where they were left open."""
        s_image = self.config.s_image if self.config.s_image is not None else self.config.s_null
        s_null = self.config.s_null if self.config.s_null is not None else self.config.s_image
        if s_image is None or s_null is None:
            raise PriorError(
                "closed-form.s_image: no spread is set. Give a number, "
                "or let guidance.fixed_point.balanced solve it for the rule and its scales"
            )
        return self.config.s, s_image, s_null

    @torch.no_grad()
    def predict_noise(self, rows: Sequence[Row], timestep: int) -> list[Float[Tensor, "B 3 H W"]]:
        """E[eps | x_t] = k_v (x_t - sqrt(abar) m), of each row's mean m and spread v; k_v is `noise_slope`."""
        abar = abar_at(self.alphas_cumprod, timestep)
        out = []
        for row in rows:
            mean, spread = self._moments(row)
            slope = noise_slope(abar, spread)
            out.append(slope * (row.noisy - abar**0.5 * mean))
        return out

    def _moments(self, row: Row) -> tuple[Float[Tensor, "B 3 H W"] | float, float]:
        s, s_image, s_null = self.spreads()
        if row.image is None and row.text is not None:
            raise PriorError(f"closed-form: the instruction '{row.text.name}' has no image to act on")
        if row.image is None:
            return self.config.mu, s_null
        if row.text is None:
            return row.image.latents, s_image
        return row.image.edited(row.text), s


@no_type_check  # numbers alone, asked for by the million where a spread is solved for
def noise_slope(abar: float, spread: float) -> float:
    """k_v = sqrt(1 - abar) / (abar v^2 + 1 - abar): how fast the noise prediction of N(m, v^2) grows with x_t."""
    return (1.0 - abar) ** 0.5 / (abar * spread**2 + 1.0 - abar)
