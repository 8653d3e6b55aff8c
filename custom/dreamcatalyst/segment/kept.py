"""The mask that an earlier run left with the splats: the extra "mask" of its PLY."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ..errors import SceneError
from .api import EXTRA, MaskRequest, Segmenter


@dataclass(frozen=True)
class Kept(Segmenter):
    """Edit after edit in one place: soft weights travel with the splats, also with those that were added."""

    def __call__(self, request: MaskRequest, views: Sequence[int]) -> Float[Tensor, " N"]:
        """Their weights. Raises SceneError where the splats carry none."""
        if EXTRA not in request.scene.extra:
            known = ", ".join(request.scene.extra) or "none"
            raise SceneError(
                f"system.mask.kind: kept needs splats with the property '{EXTRA}', such as the result of an edit with "
                f"a mask; these have no such property (further ones: {known}). Choose another kind"
            )
        return request.scene.extra[EXTRA].to(request.scene.means).reshape(-1).clamp(0, 1)

    def identity(self, request: MaskRequest) -> Float[Tensor, "N ..."] | None:
        return request.scene.extra.get(EXTRA)
