"""What a run is about to build, what it leaves out and why, and what it will cost: said before it starts.

Derived from the configuration and the scene, not from what was built: tests hold the two against each other.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..cache import tensor_bytes
from ..files import write_text
from ..guidance.distill import network_rows
from ..loss.perceptual import WEIGHT_BYTES
from ..scene.gaussians import PARAMETERS, Gaussians
from ..scene.generations import GENERATION
from ..segment.api import SEGMENTERS
from .densify import STATISTICS, DensifyConfig

if TYPE_CHECKING:
    from .edit import EditSystem
    from .system import SplatSystem

UNITS = ("B", "KiB", "MiB", "GiB")


@dataclass(frozen=True)
class Part:
    """One thing that is built (or left out). note: what it is for, or why it is not needed. bytes: what it takes,
    `at most` where it grows with use."""

    name: str
    note: str
    bytes: int = 0


@dataclass(frozen=True)
class Plan:
    """builds, leaves_out: parts. network_rows: rows that the prior's network predicts per step;
    picture_rows: rows for each picture that a rule edits on the side. pixels: rendered per step."""

    builds: tuple[Part, ...]
    leaves_out: tuple[Part, ...]
    network_rows: int
    picture_rows: int
    pixels: int

    @property
    def bytes(self) -> int:
        """Expected memory of everything that is built, without what a step needs in passing."""
        return sum(part.bytes for part in self.builds)

    def text(self) -> str:
        """For people."""
        size = [readable(part.bytes) if part.bytes else "" for part in self.builds]
        lines = [f"  + {p.name}: {p.note}{f' ({s})' if s else ''}" for p, s in zip(self.builds, size, strict=True)]
        lines += [f"  - {p.name}: {p.note}" for p in self.leaves_out]
        costs = [f"{self.pixels:,} pixels"]
        if self.network_rows:
            costs.append(f"{self.network_rows} rows of the prior")
        if self.picture_rows:
            costs.append(f"{self.picture_rows} rows of the prior for each picture that is edited")
        return "\n".join(["plan", *lines, f"  each step: {', '.join(costs)}; kept: {readable(self.bytes)}"])

    def write(self, path: Path) -> Path:
        """As JSON."""
        return write_text(path, json.dumps({**asdict(self), "bytes": self.bytes}, indent=2) + "\n")


def readable(size: float) -> str:
    """Bytes in the unit that suits them."""
    unit = 0
    while size >= 1024 and unit < len(UNITS) - 1:
        size, unit = size / 1024, unit + 1
    return f"{size:.3g} {UNITS[unit]}"


class Draft:
    """A plan in the making: what every run has, to which a system adds its own (`SplatSystem.describe`)."""

    def __init__(self, system: SplatSystem):
        self.system = system
        self.builds: list[Part] = []
        self.leaves_out: list[Part] = []
        self.network_rows = self.picture_rows = 0

    def add(self, name: str, note: str, size: int = 0) -> None:
        """Something that is built."""
        self.builds.append(Part(name, note, size))

    def leave_out(self, name: str, why: str) -> None:
        """Something that is not."""
        self.leaves_out.append(Part(name, why))

    def finish(self) -> Plan:
        """The plan, with what all runs have: splats, colour, densification, depth."""
        system = self.system
        batch, (width, height) = system.data.cfg.batch_size, view_size(system)
        self._splats(width * height)
        degree = system.splats.edited.sh_degree
        if degree:
            self.add("view-dependent colour", f"spherical harmonics of degree {degree}")
        else:
            self.leave_out("view-dependent colour", "the scene has degree 0")
        densify = system.part["densify"]
        if not densify.every:
            self.leave_out("densification", "densify.every is 0")
        elif (times := density_steps(densify, system.max_steps)) == 0:
            ends = "densify.stop" if densify.stop < system.max_steps else "the run"
            why = f"densify.start is {densify.start}, and {ends} ends it at {min(densify.stop, system.max_steps)}"
            self.leave_out("densification", why)
        elif len(system.splats) >= densify.max_splats:
            full = f"{len(system.splats):,} editable splats, max_splats {densify.max_splats:,}: raise it to add any"
            self.add("densification", f"{times} times, removing only: densify has no room ({full})")
        else:
            most = f"up to {densify.max_splats:,} editable splats"
            self.add("densification", f"{times} times, every {densify.every} steps, {most}")
            if densify.candidates:
                self.add("candidates", "faint splats that are tried in empty space, so that an edit can add something")
            else:
                self.leave_out("candidates", "densify.candidates is 0: new splats come from splats that are there")
        self.leave_out("depth", "no output asks for it")
        pixels = batch * width * height
        return Plan(tuple(self.builds), tuple(self.leaves_out), self.network_rows, self.picture_rows, pixels)

    def _splats(self, pixels: int) -> None:
        """Parameters with gradients and two moments for editable splats, plain tensors for the others."""
        splats, counted = self.system.splats, {*STATISTICS, GENERATION}
        if self.system.generations is not None:
            counted |= {*self.system.generations.states}
        own = tensor_bytes(dict(splats.edited.detach().parameters()))
        state = tensor_bytes({name: value for name, value in splats.state.items() if name not in counted})
        statistics = 4 * len(STATISTICS) * len(splats)
        note = f"{len(splats):,} of {splats.total:,} with parameters, gradients and Adam's two moments"
        self.add("editable splats", note, 4 * own + state + statistics)
        if splats.frozen is None:
            self.leave_out("frozen splats", "all splats are editable")
            return
        self.add("frozen splats", "never change: no gradient, no moment, no anchor", scene_bytes(splats.frozen))
        backend = self.system.backend
        if not backend.keeps_frozen:
            why = f"backend '{backend.name}' draws all splats in every step"
            self.leave_out("renders of frozen splats", why)
            return
        views = len(self.system.capture.views)
        most = min(self.system.part["renderer"].cache_mib * 2**20, views * view_bytes(len(splats.frozen), pixels))
        self.add("renders of frozen splats", "kept on the CPU, at most", most)


def density_steps(config: DensifyConfig, max_steps: int) -> int:
    """How often a run of `max_steps` densifies: not at its end, where nothing could come of it."""
    last = min(config.stop, max_steps) - 1
    return max(last // config.every - max(config.start - 1, 0) // config.every, 0)


def view_bytes(frozen: int, pixels: int) -> int:
    """What the CPU backend keeps of frozen splats in one view at most, about: an image, and a line and a few places in
    tile lists for each splat."""
    return 16 * pixels + 100 * frozen


def view_size(system: SplatSystem) -> tuple[int, int]:
    """Width and height of the renders, pixels."""
    camera = system.capture.cameras([system.capture.train[0]])
    return camera.width, camera.height


def scene_bytes(scene: Gaussians) -> int:
    """Of all tensors of a scene."""
    return tensor_bytes([dict(scene.parameters()), scene.extra])


def describe_edit(system: EditSystem, draft: Draft) -> None:
    """What an edit builds beyond splats: prior, source, mask, anchors, losses."""
    guidance = system.guidance
    rule, prior = guidance.rule, guidance.prior
    draft.add("prior", f"{guidance.config.prior_type}, rule {rule.name}", prior.weight_bytes)
    draft.add("source", f"{len(system.source):,} splats before the edit", scene_bytes(system.source))
    rows = network_rows(prior, rule, guidance.text, guidance.source_text, *guidance.scales)
    if rule.delivers == "gradient":
        draft.network_rows = rows * system.data.cfg.batch_size * (2 if guidance.config.noise == "paired" else 1)
    elif rule.delivers == "edit":
        draft.picture_rows = rows * guidance.config.diffusion_steps
    kind = system.part["mask"].kind
    others = [name for name in SEGMENTERS.names() if name != kind]
    if kind != "none":
        draft.add(f"mask ({kind})", "says which splats may change")
    draft.leave_out(f"masks by {', '.join(others)}", f"mask.kind is {kind}")
    _describe_anchors(system, draft)
    if system.part["loss"].lambda_perceptual > 0:
        draft.add("perceptual network", "LPIPS with VGG-16", WEIGHT_BYTES)
    else:
        draft.leave_out("perceptual network", "loss.lambda_perceptual is 0")


def _describe_anchors(system: EditSystem, draft: Draft) -> None:
    config = system.part["anchor"]
    if not config.lambdas:
        why = "anchor.kind is none" if config.kind == "none" else "all its weights are 0"
        draft.leave_out("anchors", why)
        return
    own = {name: tensor_bytes(system.splats.parameters[name]) for name in PARAMETERS if name in config.lambdas}
    note = f"{config.kind}, {config.form}, of {', '.join(own)}"
    draft.add("anchors", note, sum(own.values()) + 8 * len(system.splats))
    for name in PARAMETERS:
        if name not in config.lambdas:
            draft.leave_out(f"anchor of {name}", "its lambda is 0")
