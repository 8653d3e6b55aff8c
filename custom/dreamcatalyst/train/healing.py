"""Splats taken away, and the hole behind them healed: first the surfaces around it go on, view after view.

What was behind a thing is in the scene where another view saw it. Where none did, there is a hole: in it a fit has
nothing, or splats that no picture has judged. One view's hole is filled as a picture (inpaint/) and as a surface
(inpaint/depth.py), whose splats then stand in all the others: they are asked only for what is left.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..config import AtLeastOne, Fraction, NonNegative
from ..data.camera import Cameras
from ..errors import SceneError
from ..inpaint.depth import continue_depth
from ..render.api import Render
from ..render.lift import Evidence, lift
from ..render.surface import seen, surface_normals, surface_points, surface_splats
from ..scene.gaussians import Gaussians
from ..scene.mask import distances_to
from . import region
from .drawing import Drawer

SHOWN = 0.03  # share of a pixel that was of the thing, from which on it shows something else without it
UNJUDGED = 0.1  # of what shows of a splat now, over its surroundings' views: one that showed less before was no part of
# any picture, and a fit has left it as it happened to be
HALF = 0.5  # of a pixel that is covered


@dataclass(frozen=True)
class HealConfig:
    """Where a hole is, and what belongs to its border. Lengths in pictures are fractions of their longer side."""

    views: AtLeastOne | None = 48  # of training, spread evenly, that are looked at and filled; null: all of them
    tolerance: Fraction = 0.02  # of its depth by which a point may lie behind what a view shows and is seen by it
    slack: Fraction = 0.25  # and of its distance to the thing: what is far behind it is hidden by it in few views
    border: Fraction = 0.015  # width around a hole that the thing has tinted: filled anew in pictures
    smallest: Fraction = 0.001  # area of a hole that is filled, a fraction of the picture; smaller parts are noise
    reach: NonNegative = 0.5  # times the thing's size: what goes on farther from it than that is noise, too
    share: Fraction = 0.3  # part of what is seen of a splat that lies in holes and their borders; it may change then


@dataclass(frozen=True)
class Healed:
    """A scene without a thing.

    scene: what was there and stays, and then `added` splats; editable: bool [N], those and the border's. taken, unseen:
    how many were of the thing, and how many came to light that no view had shown. pictures: views that were filled,
    [H,W,3] in [0,1]; holes: their holes, bool [H,W].
    """

    scene: Gaussians
    editable: Bool[Tensor, " N"]
    taken: int
    unseen: int
    added: int
    pictures: dict[int, Float[Tensor, "H W 3"]]
    holes: dict[int, Bool[Tensor, "H W"]]

    @property
    def border(self) -> int:
        """How many of the splats that were there may change."""
        return int(self.editable.sum()) - self.added


@dataclass(frozen=True)
class Healer:
    """What heals. draw: renders; cameras: those of the views that are looked at, by number; fill: a picture [H,W,3] and
    its hole [H,W] to the picture without it."""

    config: HealConfig
    draw: Drawer
    cameras: Mapping[int, Cameras]
    fill: Callable[[Tensor, Tensor], Tensor]

    @torch.no_grad()
    def __call__(self, scene: Gaussians, thing: Bool[Tensor, " N"]) -> Healed:
        """`scene` without the splats of `thing`. Raises SceneError where nothing else is there."""
        if bool(thing.all()):
            raise SceneError(f"mask: all {len(scene)} splats are in it, so that nothing is left to heal. Name a part")
        return Healing(self, scene, thing).run()

    def pixels(self, length: float, view: int) -> int:
        """A length in pictures, at least 1 pixel."""
        camera = self.cameras[view]
        return max(1, round(length * max(camera.width, camera.height)))

    def evidence(self, scene: Gaussians, masks: Mapping[int, Tensor]) -> Evidence:
        """What is seen of each splat, and how much of that inside of masks [H,W], over the views that have one."""
        found, config = Evidence(*scene.means.new_zeros(2, len(scene))), self.draw.config
        for view, mask in masks.items():
            given = scene, self.cameras[view], [mask.to(scene.means)]
            found += lift(*given, backend=config.backend, antialiased=config.antialiased)
        return found


class Healing:
    """One scene's healing, step by step. before: views' depths with the thing; changed: where they showed it."""

    def __init__(self, healer: Healer, scene: Gaussians, thing: Tensor):
        self.healer, self.scene, self.thing, self.means = healer, scene, thing, scene.means[thing]
        self.before: dict[int, Tensor] = {}
        self.changed: dict[int, Tensor] = {}
        for view, camera in healer.cameras.items():
            drawn = healer.draw(scene, camera, features=thing[:, None].to(scene.means), depth=True)
            self.before[view], self.changed[view] = drawn.depth[0, ..., 0], drawn.features[0, ..., 0] > SHOWN

    def run(self) -> Healed:
        """Take away, find the holes, fill them."""
        rest = self.scene[~self.thing]
        unseen = self.unjudged(rest)
        rest = rest[~unseen]
        holes = {view: self.hole(rest, view) for view in self.healer.cameras}
        pictures, new = self.fill_views(rest, holes)
        holes = {view: holes[view] for view in pictures}
        border = self.border(rest, holes)
        added = new.means.new_ones(len(new), dtype=torch.bool)
        return Healed(
            scene=Gaussians.cat([rest, new]),
            editable=torch.cat([border, added]),
            taken=int(self.thing.sum()),
            unseen=int(unseen.sum()),
            added=len(new),
            pictures=pictures,
            holes=holes,
        )

    def unjudged(self, rest: Gaussians) -> Bool[Tensor, " R"]:
        """Splats that come to light where the thing was, and that no view had shown."""
        everywhere = {view: torch.ones_like(changed) for view, changed in self.changed.items()}
        shown = self.healer.evidence(self.scene, everywhere).total[~self.thing]
        now = self.healer.evidence(rest, self.changed).inside
        return (now > HALF) & (shown < UNJUDGED * now)

    @cached_property
    def views(self) -> list[tuple[Cameras, Tensor]]:
        """All views with what they showed before."""
        return [(self.healer.cameras[view], depth) for view, depth in self.before.items()]

    def hole(self, rest: Gaussians, view: int) -> Bool[Tensor, "H W"]:
        """Where one view now shows what no view has seen from this side, or nothing."""
        changed, config, camera = self.changed[view], self.healer.config, self.healer.cameras[view]
        if not bool(changed.any()):
            return changed
        drawn = self.healer.draw(rest, camera, depth=True)
        points = surface_points(camera, drawn.depth[0, ..., 0])
        normals, there = surface_normals(camera, points)[changed], points[changed]
        slack = config.tolerance * drawn.depth[0, ..., 0][changed]
        slack = slack + config.slack * distances_to(self.means, there)
        hole = changed & (drawn.alpha[0, ..., 0] < HALF)
        hole[changed] |= ~seen(there, normals, self.views, slack)
        return large_parts(opened(hole), config.smallest)

    def fill_views(self, rest: Gaussians, holes: dict[int, Tensor]) -> tuple[dict[int, Tensor], Gaussians]:
        """Pictures without holes by view, and the splats [A] of their surfaces: the view with the largest hole first,
        and then those in which enough of theirs is left. `holes` are narrowed to what was filled."""
        left, pictures, new = dict(holes), {}, rest[:0]
        new = new.map(torch.clone)
        while left:
            view = max(left, key=lambda v: float(left[v].float().mean()))
            hole = left.pop(view)
            if not bool(hole.any()):
                break
            drawn = self.healer.draw(Gaussians.cat([rest, new]), self.healer.cameras[view], depth=True)
            hole, surface = self.surface(drawn, hole, view)
            if not bool(hole.any()):
                continue
            holes[view] = hole
            pictures[view], more = self.fill(drawn, hole, surface, view)
            new = Gaussians.cat([new, more])
            for other in left:
                if bool(left[other].any()):
                    open_still = opened(left[other] & ~self.covered(rest, new, other))
                    left[other] = large_parts(open_still, self.healer.config.smallest)
        return pictures, new

    def surface(self, drawn: Render, hole: Tensor, view: int) -> tuple[Tensor, Tensor]:
        """Those parts of a hole [H,W] that are closed near the thing, and the depth [H,W] that closes them."""
        healer, width = self.healer, self.healer.pixels(self.healer.config.border, view)
        depth = continue_depth(drawn.depth[0, ..., 0], widened(hole, width), 2 * width)
        away = torch.full_like(depth, torch.inf)
        away[hole] = distances_to(self.means, surface_points(healer.cameras[view], depth)[hole])
        size = (self.means.amax(dim=0) - self.means.amin(dim=0)).max()
        return large_parts(hole & (away <= healer.config.reach * size), healer.config.smallest), depth

    def fill(self, drawn: Render, hole: Tensor, depth: Tensor, view: int) -> tuple[Tensor, Gaussians]:
        """One view's picture without its hole, and splats at `depth` that show it. drawn: the view as it is."""
        healer, rgb = self.healer, drawn.rgb[0].clamp(0, 1)
        picture = healer.fill(rgb, widened(hole, healer.pixels(healer.config.border, view)))
        splats = surface_splats(healer.cameras[view], depth, picture, widened(hole, 1), self.scene.sh_degree)
        extra = {name: value.new_zeros(len(splats), *value.shape[1:]) for name, value in self.scene.extra.items()}
        return picture, splats.with_extra(**extra)

    def covered(self, rest: Gaussians, new: Gaussians, view: int) -> Bool[Tensor, "H W"]:
        """Where one view shows new splats."""
        share = torch.cat([rest.means.new_zeros(len(rest), 1), new.means.new_ones(len(new), 1)])
        drawn = self.healer.draw(Gaussians.cat([rest, new]), self.healer.cameras[view], features=share)
        return drawn.features[0, ..., 0] > HALF

    def border(self, rest: Gaussians, holes: Mapping[int, Tensor]) -> Bool[Tensor, " R"]:
        """Splats of which much is seen in holes and around them, by the views that were filled."""
        healer = self.healer
        around = {view: widened(hole, healer.pixels(2 * healer.config.border, view)) for view, hole in holes.items()}
        found = healer.evidence(rest, around)
        return (found.total > HALF) & (found.inside > healer.config.share * found.total)


def widened(mask: Bool[Tensor, "H W"], pixels: int) -> Bool[Tensor, "H W"]:
    """The mask and every pixel at most so many away along both axes."""
    return region.widened(mask[None, ..., None].float(), pixels)[0, ..., 0] > 0


def opened(mask: Bool[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """The mask without what is narrower than three pixels: the noise of depths along outlines."""
    return widened(~widened(~mask, 1), 1) & mask


def large_parts(mask: Bool[Tensor, "H W"], smallest: float) -> Bool[Tensor, "H W"]:
    """The connected parts of a mask whose area is at least `smallest`, a fraction of the picture."""
    from scipy import ndimage

    parts = cast(tuple[np.ndarray, int], ndimage.label(mask.cpu().numpy()))[0]
    areas = np.bincount(parts.ravel())
    areas[0] = 0  # what is no part
    return torch.from_numpy((areas >= max(1, smallest * parts.size))[parts]).to(mask.device)
