"""What a run is about to build, what it leaves out and why, and what it will cost: said before it starts.

Derived from the configuration and the scene, not from what was built: tests hold the two against each other.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from ..cache import tensor_bytes
from ..files import write_text
from ..guidance.guidance import Guidance
from ..loss.anchor import AnchorConfig
from ..loss.perceptual import WEIGHT_BYTES
from ..render.api import Backend
from ..scene.gaussians import PARAMETERS, Gaussians
from ..scene.trainable import Splats
from ..segment.api import SEGMENTERS
from .density import DensifyConfig

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
        if not self.pixels:  # a run without steps
            return "\n".join(["plan", *lines])
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


class PlanBuilder:
    """A plan in the making."""

    def __init__(self) -> None:
        self.builds: list[Part] = []
        self.leaves_out: list[Part] = []
        self.network_rows = self.picture_rows = 0

    def add(self, name: str, note: str, size: int = 0) -> None:
        """Something that is built."""
        self.builds.append(Part(name, note, size))

    def leave_out(self, name: str, why: str) -> None:
        """Something that is not."""
        self.leaves_out.append(Part(name, why))

    def finish(self, pixels: int) -> Plan:
        """The plan. pixels: rendered per step."""
        return Plan(tuple(self.builds), tuple(self.leaves_out), self.network_rows, self.picture_rows, pixels)

    # --- what every run has

    def splats(
        self, splats: Splats, counted: Sequence[str], backend: Backend, cache: int, views: int, size: int
    ) -> None:
        """Parameters with gradients and two moments for editable splats, plain tensors for the others.

        counted: per-splat state that is listed elsewhere. cache: bytes of frozen renders at most. views: how many
        there are, of `size` pixels each.
        """
        own = tensor_bytes(dict(splats.edited.detach().parameters()))
        state = tensor_bytes({name: value for name, value in splats.state.items() if name not in counted})
        note = f"{len(splats):,} of {splats.total:,} with parameters, gradients and Adam's two moments"
        self.add("editable splats", note, 4 * own + state)
        if splats.frozen is None:
            self.leave_out("frozen splats", "all splats are editable")
        else:
            self.add("frozen splats", "never change: no gradient, no moment, no anchor", scene_bytes(splats.frozen))
            if backend.keeps_frozen:
                most = min(cache, views * view_bytes(len(splats.frozen), size))
                self.add("renders of frozen splats", "kept on the CPU, at most", most)
            else:
                self.leave_out("renders of frozen splats", f"backend '{backend.name}' draws all splats in every step")
        degree = splats.edited.sh_degree
        if degree:
            self.add("view-dependent colour", f"spherical harmonics of degree {degree}")
        else:
            self.leave_out("view-dependent colour", "the scene has degree 0")

    def density(self, config: DensifyConfig, editable: int, max_steps: int) -> None:
        """Density control of a run of `max_steps`, which begins with `editable` splats."""
        if not config.every:
            self.leave_out("densification", "densify.every is 0")
        elif (times := config.times(max_steps)) == 0:
            ends = "densify.stop" if config.stop < max_steps else "the run"
            why = f"densify.start is {config.start}, and {ends} ends it at {min(config.stop, max_steps)}"
            self.leave_out("densification", why)
        elif config.strategy != "adaptive":
            self.add("densification", f"{times} times, every {config.every} steps, by strategy {config.strategy}")
        elif editable >= config.max_splats:
            full = f"{editable:,} editable splats, max_splats {config.max_splats:,}: raise it to add any"
            self.add("densification", f"{times} times, removing only: densify has no room ({full})")
        else:
            most = f"up to {config.max_splats:,} editable splats"
            self.add("densification", f"{times} times, every {config.every} steps, {most}")
            if config.candidates:
                self.add("candidates", "faint splats that are tried in empty space, so that an edit can add something")
            else:
                self.leave_out("candidates", "densify.candidates is 0: new splats come from splats that are there")

    # --- what an edit has

    def prior(self, guidance: Guidance, batch: int) -> None:
        """The prior, and how often its network is asked in a step of `batch` views."""
        objective, name = guidance.objective, guidance.rule.name
        self.add("prior", f"{guidance.config.prior_type}, rule {name}", guidance.prior.weight_bytes)
        self.network_rows, self.picture_rows = objective.network_rows * batch, objective.picture_rows

    def mask(self, kind: str) -> None:
        """The one kind of mask, or none, and the others."""
        others = [name for name in SEGMENTERS.names() if name != kind]
        if kind != "none":
            self.add(f"mask ({kind})", "says which splats may change")
        self.leave_out(f"masks by {', '.join(others)}", f"mask.kind is {kind}")

    def anchors(self, config: AnchorConfig, splats: Splats) -> None:
        """What splats are held to."""
        if not config.lambdas:
            why = "anchor.kind is none" if config.kind == "none" else "all its weights are 0"
            self.leave_out("anchors", why)
            return
        own = {name: tensor_bytes(splats.parameters[name]) for name in PARAMETERS if name in config.lambdas}
        note = f"{config.kind}, {config.form}, of {', '.join(own)}"
        self.add("anchors", note, sum(own.values()) + 8 * len(splats))
        for name in PARAMETERS:
            if name not in config.lambdas:
                self.leave_out(f"anchor of {name}", "its lambda is 0")

    def perceptual(self, weight: float) -> None:
        """LPIPS."""
        if weight > 0:
            self.add("perceptual network", "LPIPS with VGG-16", WEIGHT_BYTES)
        else:
            self.leave_out("perceptual network", "loss.lambda_perceptual is 0")


def view_bytes(frozen: int, pixels: int) -> int:
    """What the CPU backend keeps of frozen splats in one view at most, about: an image, and a line and a few places in
    tile lists for each splat."""
    return 16 * pixels + 100 * frozen


def scene_bytes(scene: Gaussians) -> int:
    """Of all tensors of a scene."""
    return tensor_bytes([dict(scene.parameters()), scene.extra])
