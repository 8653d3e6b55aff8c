"""Adaptive density control: where splats are added and where they go.

Source: Kerbl et al. 2023, section 5.2, with the selection of a top fraction as in GaussianEditor (Chen et al. 2024).
Candidates in empty space are ours: an edit may add a hat where nothing is that could be cloned.
All decisions are taken on gradients of the unscaled loss, after the optimizer's step, so that no update is lost and
neither mixed precision nor the number of views per step changes what is densified.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from .. import plugin
from ..diffusion.noise import keyed_generator
from ..errors import SceneError
from ..render.api import Render
from ..scene.gaussians import Gaussians
from ..scene.generations import Generations
from ..scene.trainable import Splats
from .density import DensifyConfig, Density, Moment

STATISTICS = ("grad_sum", "grad_count", "max_radius")
SPLIT_SHRINK = 1.6  # a split splat's two children have scales divided by this (3DGS: 0.8 * 2)
RESET_OPACITY = 0.01  # opacities above it are brought down to it at a reset (3DGS)


@dataclass(frozen=True)
class DensifyReport:
    """What one densification did, in numbers of splats. held_back: for which max_splats left no room; tried: candidates
    that were added."""

    cloned: int = 0
    split: int = 0
    pruned: int = 0
    held_back: int = 0
    tried: int = 0


def screen_statistics(splats: Splats) -> dict[str, Tensor]:
    """Fresh statistics for every editable splat."""
    return {name: splats.parameters["means"].new_zeros(len(splats)) for name in STATISTICS}


@torch.no_grad()
def observe(splats: Splats, render: Render, loss_scale: float = 1.0) -> None:
    """Add one step's screen gradients to the statistics. Call between backward and densify.

    loss_scale: what the loss was multiplied by before backward (mixed precision). The loss is taken as a mean over the
    render's V views, so that each view's own gradient is V times what arrived. Steps with a non-finite gradient (an
    overflow of mixed precision, which the optimizer skips too) are left out.
    """
    grad = render.means2d.grad
    if grad is None or not torch.isfinite(grad).all():
        return
    first = grad.shape[1] - len(splats)  # editable splats stand last
    grad, radii = grad[:, first:], render.radii[:, first:]
    views, height, width = render.rgb.shape[:3]
    half = grad.new_tensor([width / 2, height / 2])
    size = (grad * half).norm(dim=-1) * (views / loss_scale)  # [V,E]
    seen = radii > 0
    splats.state["grad_sum"] += (size * seen).sum(0)
    splats.state["grad_count"] += seen.sum(0).to(size.dtype)
    splats.state["max_radius"] = torch.maximum(splats.state["max_radius"], radii.amax(0).to(size.dtype))


def select(gradient: Tensor, config: DensifyConfig, room: int) -> tuple[Tensor, int]:
    """Which splats are densified, bool [N]: above the threshold, in the top fraction, no more than there is room; and
    how many more would be if there were."""
    chosen = gradient >= config.grad_threshold
    chosen &= gradient > 0
    wanted = min(math.ceil(config.top_fraction * int((gradient > 0).sum())), int(chosen.sum()))
    limit = min(wanted, max(room, 0))
    if int(chosen.sum()) > limit:
        order = torch.argsort(torch.where(chosen, gradient, -1.0), descending=True, stable=True)
        chosen = torch.zeros_like(chosen)
        chosen[order[:limit]] = True
    return chosen, wanted - limit


def split_children(scene: Gaussians, generator: torch.Generator) -> dict[str, Tensor]:
    """Two children for each of S splats, all first ones before all second ones: means [2S,3] drawn from the splat
    itself, log_scales [2S,3] divided by 1.6. Drawn on the CPU, so that it is the same on every device."""
    noise = torch.randn(2 * len(scene), 3, generator=generator).to(scene.means)
    q = torch.nn.functional.normalize(scene.quats, dim=-1).repeat(2, 1)
    offset = noise * scene.scales.repeat(2, 1)
    uv = torch.linalg.cross(q[:, 1:], offset)
    rotated = offset + 2 * (q[:, :1] * uv + torch.linalg.cross(q[:, 1:], uv))
    return {
        "means": scene.means.repeat(2, 1) + rotated,
        "log_scales": scene.log_scales.repeat(2, 1) - math.log(SPLIT_SHRINK),
    }


def candidate_parents(gradient: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Indices [count] of splats, drawn with probability ~ gradient^2 [N]: where the images ask for most, and hardly
    where there is no more than the noise that every splat sees. Drawn on the CPU. At least one gradient is not 0."""
    cumulated = (gradient.double() / gradient.amax()).square().cpu().cumsum(0)
    drawn = torch.rand(count, generator=generator, dtype=torch.float64) * cumulated[-1]
    return torch.searchsorted(cumulated, drawn, right=True).clamp(max=len(gradient) - 1).to(gradient.device)


def candidate_children(
    scene: Gaussians, config: DensifyConfig, extent: float, generator: torch.Generator
) -> dict[str, Tensor]:
    """Faint round splats about each of S parents, in empty space too. Cloning and splitting stay where splats are, and
    what an edit adds must begin where there are none: these make that space differentiable."""
    offset = torch.randn(len(scene), 3, generator=generator).to(scene.means)
    return {
        "means": scene.means + offset * (config.candidate_reach * extent),
        "log_scales": scene.log_scales.amax(-1, keepdim=True).repeat(1, 3),
        "logit_opacities": torch.full_like(scene.logit_opacities, math.log(config.candidate_opacity))
        - math.log1p(-config.candidate_opacity),
    }


@torch.no_grad()
def densify(
    splats: Splats,
    config: DensifyConfig,
    extent: float,
    generator: torch.Generator,
    generations: Generations | None = None,
    explore: bool = False,
) -> DensifyReport:
    """Clone, split and prune the editable splats once, and start the statistics anew. extent: the scene's size in world
    units. explore: try candidates, too. Children inherit all state of their parents, but are a new one of
    `generations`, if these are kept; anchors and weights of all generations then move on, even where nothing was added.

    All editable splats may go where frozen ones are left, since an object that fades away is a valid edit. Raises
    SceneError, and changes nothing, where no splat at all would be left.
    """
    scene, state = splats.edited.detach(), splats.state
    gradient = state["grad_sum"] / state["grad_count"].clamp(min=1)
    largest = scene.scales.amax(-1)
    faint = scene.opacities < config.min_opacity
    room = config.max_splats - len(splats) + int(faint.sum())
    chosen, held_back = select(torch.where(faint, 0.0, gradient), config, room)
    small = largest <= config.dense_size * extent
    clone, split = chosen & small, chosen & ~small
    gone = faint.clone()
    if config.max_size > 0:
        gone |= largest > config.max_size * extent
    if config.max_radius > 0:
        gone |= state["max_radius"] > config.max_radius
    gone &= ~split
    clone &= ~gone
    cloned, halved = clone.nonzero()[:, 0], split.nonzero()[:, 0]
    parents, kept = torch.cat([cloned, halved, halved]), (~gone & ~split).nonzero()[:, 0]
    if splats.frozen is None and len(kept) + len(parents) == 0:
        raise SceneError("density control would remove every splat; lower system.densify.min_opacity")
    children = split_children(scene[halved], generator)
    changed = {name: torch.cat([getattr(scene, name)[cloned], value]) for name, value in children.items()}
    tried = max(round(config.candidates * len(scene)), config.candidates_least) if explore else 0
    tried = min(tried, max(room - len(cloned) - len(halved), 0))
    asked = torch.where(gone, 0.0, gradient)
    if tried and bool(asked.any()):
        origins = candidate_parents(asked, tried, generator)
        new = candidate_children(scene[origins], config, extent, generator)
        before = {name: getattr(scene, name)[parents] for name in new} | changed
        changed = {name: torch.cat([before[name], value]) for name, value in new.items()}
        parents = torch.cat([parents, origins])
    if generations is not None:
        changed |= generations.newborn(splats, parents, changed)
    splats.rearrange(kept, parents, changed)
    if generations is not None:
        generations.advance(splats)
    splats.state.update(screen_statistics(splats))
    return DensifyReport(len(cloned), len(halved), int(gone.sum()), held_back, tried)


@torch.no_grad()
def reset_opacity(splats: Splats) -> None:
    """Bring every opacity down to 0.01 at most and forget its moments (Kerbl et al. 2023: lets floaters die)."""
    logits = splats.parameters["logit_opacities"]
    logits.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    for key, value in (splats.optimizer.state.get(logits, {}) if splats.optimizer else {}).items():
        if value.shape == logits.shape:
            splats.optimizer.state[logits][key] = torch.zeros_like(value)


class Adaptive(Density):
    """Adaptive density control with this file's functions, and opacity resets."""

    states = STATISTICS
    _cap_announced = False

    def begin(self, splats: Splats) -> None:
        splats.state.update(screen_statistics(splats))

    def observe(self, splats: Splats, render: Render, loss_scale: float = 1.0) -> None:
        observe(splats, render, loss_scale)

    def after_step(self, splats: Splats, moment: Moment) -> None:
        super().after_step(splats, moment)
        every, step = self.config.reset_every, moment.step
        if every and step < min(self.config.stop, moment.max_steps) and step % every == 0:
            reset_opacity(splats)

    def densify(self, splats: Splats, moment: Moment) -> None:
        config, step = self.config, moment.step
        generator = keyed_generator(moment.seed, "split", step)
        explore = config.candidates > 0 and step <= config.candidates_until * moment.max_steps
        report = densify(splats, config, moment.extent, generator, moment.generations, explore)
        if report.held_back and not self._cap_announced:
            self._cap_announced = True
            plugin.warn(
                f"densification at step {step}: {report.held_back:,} splats to be divided have no room beside "
                f"{len(splats):,} editable ones; raise system.densify.max_splats ({config.max_splats:,})"
            )
