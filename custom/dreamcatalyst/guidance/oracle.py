"""Pictures that an exact prior knows beforehand: its edit, and where a rule comes to rest. docs/closed-form.md"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor

from .fixed_point import fixed_point
from .prompted import PromptedPrior
from .rules import Rule


def known_edit(prompted: PromptedPrior, source: Float[Tensor, "H W 3"], index: int) -> Float[Tensor, "H W 3"] | None:
    """The edit that the prior knows of a view's source render, in [0,1]; None for a prior that learned."""
    return exact_edit(prompted, source, index, prompted.text) if prompted.prior.exact else None


def resting_picture(
    prompted: PromptedPrior, rule: Rule, source: Float[Tensor, "H W 3"], index: int, timesteps: Sequence[int]
) -> Float[Tensor, "H W 3"] | None:
    """Where the rule's mean gradient over `timesteps` vanishes, clamped to [0,1]; None where it is not known
    or not stable."""
    if not prompted.prior.exact:
        return None
    rest = fixed_point(prompted.closed_form, rule, timesteps, *prompted.scales)
    if rest is None:
        return None
    edit, reference = (exact_edit(prompted, source, index, text) for text in (prompted.text, prompted.source_text))
    from_mean = source - (prompted.prior.config.mu + 1.0) / 2.0
    return (source + rest.rho * (edit - reference) + rest.drift * from_mean).clamp(0, 1)


def exact_edit(
    prompted: PromptedPrior, source: Float[Tensor, "H W 3"], index: int, text: Any
) -> Float[Tensor, "H W 3"]:
    """What `text` (of `Prior.embed`) makes of a view's source render, in [0,1]. Raises PriorError for a prior
    that is not exact."""
    return prompted.prior.known_edit(prompted.encode_source(source, index)[1], text)[0].permute(1, 2, 0)
