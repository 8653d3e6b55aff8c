"""What an edit is about to build, what it leaves out and why, and what it will cost: said before it starts.

Derived from the configuration and the scene, not from what was built: tests hold the two against each other.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..cache import tensor_bytes
from ..guidance.distill import network_rows
from ..scene.gaussians import PARAMETERS, Gaussians
from ..scene.generations import GENERATION
from ..segment.api import SEGMENTERS
from .densify import STATISTICS

if TYPE_CHECKING:
    from .edit import EditSystem

PERCEPTUAL_BYTES = 4 * 14_715_000  # VGG-16's convolutions in float32
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
        rows = f"{self.network_rows} rows of the prior"
        if self.picture_rows:
            rows += f" ({self.picture_rows} for each picture that is edited)"
        return "\n".join(["plan", *lines, f"  per step: {rows}, {self.pixels:,} pixels; kept: {readable(self.bytes)}"])

    def write(self, path: Path) -> Path:
        """As JSON."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({**asdict(self), "bytes": self.bytes}, indent=2) + "\n", encoding="utf-8")
        return path


def readable(size: float) -> str:
    """Bytes in the unit that suits them."""
    unit = 0
    while size >= 1024 and unit < len(UNITS) - 1:
        size, unit = size / 1024, unit + 1
    return f"{size:.3g} {UNITS[unit]}"


def edit_plan(system: EditSystem) -> Plan:
    """The plan of an edit whose prior is loaded, whose scene is read and whose mask is known."""
    built: list[Part] = []
    left: list[Part] = []

    def decide(wanted: bool, name: str, note: str, why_not: str, size: int = 0) -> None:
        (built if wanted else left).append(Part(name, note if wanted else why_not, size if wanted else 0))

    capture, guidance = system.capture, system.guidance
    rule, prior, degree = guidance.rule, guidance.prior, system.source.sh_degree
    built.append(Part("prior", f"{guidance.config.prior_type}, rule {rule.name}", prior.weight_bytes))
    built.append(Part("source", f"{len(system.source):,} splats before the edit", scene_bytes(system.source)))
    _decide_splats(system, decide)
    decide(degree > 0, "view-dependent colour", f"spherical harmonics of degree {degree}", "the scene has degree 0")
    decide(False, "depth", "", "no output asks for it")
    _decide_anchors(system, decide)
    config = system.part["mask"]
    decide(config.kind != "none", f"mask ({config.kind})", "says which splats may change", "mask.kind is none")
    others = [kind for kind in SEGMENTERS.names() if kind != config.kind]
    decide(False, f"other kinds of mask ({', '.join(others)})", "", "not asked for")
    perceptual = system.part["loss"].lambda_perceptual > 0
    decide(perceptual, "perceptual network", "LPIPS with VGG-16", "loss.lambda_perceptual is 0", PERCEPTUAL_BYTES)
    densify = system.part["densify"]
    active = bool(densify.every) and densify.start < min(densify.stop, system.max_steps + 1)
    decide(active, "densification", f"every {densify.every} steps, up to {densify.max_splats:,} splats",
           "densify.every is 0" if not densify.every else "it would start after the end of the run")  # fmt: skip
    rows, batch = (
        network_rows(prior, rule, guidance.text, guidance.source_text, *guidance.scales),
        system.data.cfg.batch_size,
    )
    each = rows * batch * (2 if guidance.config.noise == "paired" else 1) if rule.delivers == "gradient" else 0
    edits = rows * guidance.config.diffusion_steps if rule.delivers == "edit" else 0
    camera = capture.cameras([capture.train[0]])
    return Plan(tuple(built), tuple(left), each, edits, batch * camera.width * camera.height)


def scene_bytes(scene: Gaussians) -> int:
    """Of all tensors of a scene."""
    return tensor_bytes([dict(scene.parameters()), scene.extra])


def _decide_splats(system: EditSystem, decide) -> None:
    """Parameters with gradients and two moments for editable splats, plain tensors for the others."""
    splats = system.splats
    own = tensor_bytes(dict(splats.edited.detach().parameters()))
    note = f"{len(splats):,} of {splats.total:,} with parameters, gradients and Adam's two moments"
    per_row = {n: v for n, v in splats.state.items() if n not in system_states(system)}
    statistics = 4 * len(STATISTICS) * len(splats)
    decide(True, "editable splats", note, "", 4 * own + tensor_bytes(per_row) + statistics)
    cache = system.part["renderer"].cache_mib * 2**20
    frozen = splats.frozen
    decide(frozen is not None, "frozen splats", "never change: no gradient, no moment, no anchor; renders of them kept",
           "no mask: all splats are editable", 0 if frozen is None else scene_bytes(frozen) + cache)  # fmt: skip


def _decide_anchors(system: EditSystem, decide) -> None:
    lambdas = system.part["anchor"].lambdas
    own = {name: tensor_bytes(system.splats.parameters[name]) for name in PARAMETERS if name in lambdas}
    config = system.part["anchor"]
    why = "anchor.kind is none" if config.kind == "none" else "all its weights are 0"
    size = sum(own.values()) + 8 * len(system.splats)
    decide(bool(lambdas), "anchors", f"{config.kind}, {config.form}, of {', '.join(own)}", why, size)
    for name in PARAMETERS:
        if lambdas and name not in lambdas:
            decide(False, f"anchor of {name}", "", "its lambda is 0")


def system_states(system: EditSystem) -> set[str]:
    """States that other parts count."""
    return {*STATISTICS, GENERATION, *(system.generations.states if system.generations else ())}
