"""What an edit of a made world should have become: known in 3D, and so at every view."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ..data.camera import Cameras
from ..demo.edits import Edit, apply_edit, find_edit, possible
from ..demo.worlds import World
from ..render.api import Render


class Truth:
    """The edit of a world that an instruction asks for. scene: the world's splats after it, in the same order, and
    after them what the edit adds. share [N,1]: 1 for the splats that the edit is about: its target's, or where it adds
    something, what it adds."""

    def __init__(self, world: World, edit: Edit, device: torch.device):
        self.edit, self.scene = edit, apply_edit(world, edit.name).to(device)
        self.before = world.scene.to(device)
        rows = world.thing(edit.target).rows if edit.target else (0, len(world.scene))
        if edit.adds:
            rows = len(world.scene), len(self.scene)
        self.share = self.scene.means.new_zeros(len(self.scene), 1)
        self.share[rows[0] : rows[1]] = 1

    @torch.no_grad()
    def image(self, draw: Callable[..., Render], camera: Cameras) -> Tensor:
        """The edited world at one view, [H,W,3] in [0,1]."""
        return draw(self.scene, camera).rgb[0].clamp(0, 1)

    @torch.no_grad()
    def region(self, draw: Callable[..., Render], camera: Cameras) -> Tensor | None:
        """Where one view shows the thing that is edited, before or after (what is added: after), [H,W,1] of 0 and 1;
        None for global edits."""
        if self.edit.target is None:
            return None
        scenes = [self.scene] if self.edit.adds else [self.before, self.scene]
        shares = [draw(scene, camera, features=self.share).features[0] for scene in scenes]
        return torch.stack(shares).amax(0).round()


def find_truth(world: World | None, instruction: str, device: torch.device) -> Truth | None:
    """The truth of an instruction in a made world; None for a capture, an edit that the world's list does not know, and
    one that makes no sense there."""
    edit = find_edit(instruction) if world is not None else None
    if edit is None or edit.name not in [each.name for each in possible(world)]:
        return None
    return Truth(world, edit, device)
