"""Learning rates of the six parameter groups."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..config import BelowOne, Count, PositiveFraction, Rate, value

GROUPS = dict(means="means", quats="quats", scales="log_scales", opacities="logit_opacities", sh0="sh0", shN="shN")


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rates; each may be a schedule. Defaults: 3DGS (Kerbl et al. 2023)."""

    means: Rate = 1.6e-4  # of the scene's extent per step
    quats: Rate = 1e-3
    scales: Rate = 5e-3  # of the logarithm
    opacities: Rate = 5e-2  # of the logit
    sh0: Rate = 2.5e-3
    shN: Rate = 1.25e-4
    means_decay: PositiveFraction = 0.01  # the rate of the means ends at this fraction, geometrically over the run
    decay: PositiveFraction = 1.0  # the same for all other rates
    beta2: BelowOne = 0.999  # how long Adam remembers the size of gradients: 1 / (1 - beta2) steps
    warm_up_steps: Count = 0  # all rates grow from zero over so many steps

    def at(self, step: int, max_steps: int, extent: float, epoch: int = 0) -> dict[str, float]:
        """The rate of each parameter (by its name in the scene) at `step` of `max_steps`. extent: world units."""
        progress = min(step / max(max_steps - 1, 1), 1.0)
        warm = min((step + 1) / self.warm_up_steps, 1.0) if self.warm_up_steps else 1.0
        rates = {}
        for key, parameter in GROUPS.items():
            decay = self.means_decay if key == "means" else self.decay
            rate = value(getattr(self, key), epoch, step) * warm * math.exp(progress * math.log(decay))
            rates[parameter] = rate * extent if key == "means" else rate
        return rates
