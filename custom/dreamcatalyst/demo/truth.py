"""What an edit of a synthetic scene becomes: the world's splats after it, and which of them it is about."""

from __future__ import annotations

from ..data.truth import GroundTruth
from .edits import WorldEdit, apply_edit, possible
from .worlds import World


def ground_truth(world: World, edit: WorldEdit | None) -> GroundTruth | None:
    """The outcome of an edit; None for None, and for one that makes no sense in this world.

    The edit is about its target's splats or, where it adds something, about what it adds.
    """
    if edit is None or edit.name not in [each.name for each in possible(world)]:
        return None
    scene = apply_edit(world, edit.name)
    if edit.target is None:
        return GroundTruth(scene)
    first, last = (len(world.scene), len(scene)) if edit.adds else world.thing(edit.target).rows
    share = scene.means.new_zeros(len(scene), 1)
    share[first:last] = 1
    return GroundTruth(scene, share, None if edit.adds else world.scene)
