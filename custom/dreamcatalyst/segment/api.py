"""Which splats an edit may touch: asked of a segmenter, carried from its pictures to the splats, kept in a cache."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from ..config import AtLeastOne, NonNegative, PositiveFraction, parse
from ..data.camera import Cameras
from ..errors import ConfigError, choose
from ..guidance.guidance import Guidance
from ..kept import digest
from ..registry import Registry
from ..render.lift import Evidence, lift, vote
from ..scene import mask as masks
from ..scene.gaussians import Gaussians
from . import cache

SEGMENTERS = Registry("kind of mask", __package__)
SEGMENTERS.add("files", ".files:Files")
SEGMENTERS.add("box", ".box:Box")
SEGMENTERS.add("relevance", ".relevance:Relevance")
SEGMENTERS.add("text", ".text:Text")
SEGMENTERS.add("kept", ".kept:Kept")

NONE = "none"
VOTES = ("weighted", "gaussian-editor")
EXTRA = "mask"  # the name of the soft weights among a scene's extras, and so in its PLY


@dataclass(frozen=True)
class MaskConfig:
    """Where the mask comes from and how it becomes a set of splats: threshold, then grow, then invert, then feather."""

    kind: str = NONE  # none | files | box | relevance | text | kept: what says which part is meant
    options: dict = field(default_factory=dict)  # the kind's own: the fields of segment/<kind>.py
    views: AtLeastOne | None = 24  # views that are looked at, spread evenly over those of training; null: all of them
    vote: str = "weighted"  # by how much of a splat is seen; gaussian-editor: by pixels, as its code does (on the CPU)
    min_evidence: NonNegative = 0.5  # pixels of a splat to be seen over all views, else its neighbours decide
    neighbours: AtLeastOne = 8  # nearest decided splats that decide for one
    threshold: PositiveFraction = 0.5  # of the weight, in (0,1]
    grow: NonNegative = 0.0  # distance to the found splats within which others join, a fraction of the scene's extent
    invert: bool = False  # everything else
    feather: NonNegative = 0.0  # width over which updates fall off towards the mask's border, fraction of the extent
    cache: str = ""  # folder in which masks are kept; empty: the run's own choice

    def __post_init__(self) -> None:
        choose("kind of mask", self.kind, (NONE, *SEGMENTERS.names()), "kind")
        choose("vote", self.vote, VOTES, "vote")
        if self.kind == NONE and (self.options or self.invert):
            raise ConfigError(f"kind: none takes no options and no invert. Known: {', '.join(SEGMENTERS.names())}.")

    def segmenter(self) -> Segmenter | None:
        """The kind with its options, None for none. Raises ConfigError for options that cannot be."""
        if self.kind == NONE:
            return None
        return parse(SEGMENTERS.get(self.kind), self.options, "system.mask.options")


@dataclass(frozen=True)
class MaskRequest:
    """What a mask is made for.

    scene: N splats. cameras: one batch of one per view of the capture, names: theirs; views: numbers of the views that
    may be looked at (those of training). extent: of the scene, world units, as `Capture.extent`. render: number of a
    view to its source render. guidance: for kinds that ask the prior. prompt: the instruction.
    backend, antialiased, background: how `render` draws. origin: the point of the user's world that is (0,0,0) here.
    """

    scene: Gaussians
    cameras: Sequence[Cameras]
    names: Sequence[str]
    views: Sequence[int]
    extent: float
    render: Callable[[int], Float[Tensor, "H W 3"]]
    guidance: Guidance | None = None
    prompt: str = ""
    backend: str = "auto"
    antialiased: bool = False
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def spread(self, count: int | None) -> list[int]:
        """`count` of `views` spread evenly over them, all where there are no more or count is None."""
        if count is None or count >= len(self.views):
            return list(self.views)
        return [self.views[round(float(i))] for i in torch.linspace(0, len(self.views) - 1, count, dtype=torch.float64)]


class Segmenter(ABC):
    """One kind of mask: a frozen dataclass whose fields are its options. Paths and prompts are in them."""

    @abstractmethod
    def __call__(
        self, request: MaskRequest, views: Sequence[int]
    ) -> dict[int, Float[Tensor, "H W"]] | Float[Tensor, " N"]:
        """Number of a view to its mask in [0,1], for some or all of `views` (or others that the options name);
        or, where no picture is needed, weights of the splats in [0,1]."""

    def identity(self, request: MaskRequest) -> Any:
        """What the result depends on beside the options, the request's splats, cameras and renders."""
        return None


@dataclass(frozen=True)
class Mask:
    """weights in [0,1]: how much of each splat is meant, before the threshold, and inverted where that was asked;
    mask: the splats that may change; update: by which fraction of a step, 0 outside of the mask.
    images: the pictures it was made of, number of a view to one in [0,1], in steps of 1/255; none for 3D boxes."""

    weights: Float[Tensor, " N"]
    mask: Bool[Tensor, " N"]
    update: Float[Tensor, " N"]
    images: dict[int, Float[Tensor, "H W"]]


def make_mask(config: MaskConfig, request: MaskRequest, folder: Path | None = None) -> Mask | None:
    """The mask that `config` describes; None where its kind is none.

    folder: where weights and pictures are kept where the config names no place; None: nowhere. They are found again by
    all that made them; threshold, grow, invert and feather come after, so that trying others of them costs nothing.
    Raises ConfigError for options that cannot be, SceneError for an empty mask, and what the segmenter raises.
    """
    segmenter = config.segmenter()
    if segmenter is None:
        return None
    folder = Path(config.cache).expanduser() if config.cache else folder
    key = digest(cache.code(), *_made_of(config, segmenter, request)) if folder else ""
    found = cache.load(folder, key, len(request.scene)) if folder else None
    if found is None:
        found = _find(config, segmenter, request)
        if folder:
            cache.save(folder, key, *found)
    weights, images = found
    weights = weights.to(request.scene.means)
    means, chosen = request.scene.means, masks.threshold(weights, config.threshold)
    chosen = masks.grow(means, chosen, config.grow * request.extent)
    if config.invert:
        weights, chosen = 1 - weights, masks.invert(chosen)
    update = masks.feather(means, chosen, config.feather * request.extent)
    return Mask(weights, chosen, update, {view: image.float() / 255 for view, image in images.items()})


def _made_of(config: MaskConfig, segmenter: Segmenter, request: MaskRequest) -> tuple[Any, ...]:
    cameras = [(c.viewmats, c.Ks, c.width, c.height) for c in request.cameras]
    seen = request.names, list(request.views), request.backend, request.antialiased, request.background
    carried = config.kind, config.views, config.vote, config.min_evidence, config.neighbours
    return dict(request.scene.parameters()), cameras, seen, carried, segmenter, segmenter.identity(request)


def _find(
    config: MaskConfig, segmenter: Segmenter, request: MaskRequest
) -> tuple[Float[Tensor, " N"], dict[int, UInt8[Tensor, "H W"]]]:
    """Weights and the pictures that they come from."""
    found = segmenter(request, request.spread(config.views))
    if isinstance(found, Tensor):
        return found, {}
    # In 8 bits before anything is made of them: pictures that are written and read again give the same mask.
    images = {view: (image.clamp(0, 1) * 255).round().to(torch.uint8).cpu() for view, image in found.items()}
    evidence = sum_evidence(config, request, images)
    if config.vote == "gaussian-editor":
        return evidence.inside / (evidence.total + 1e-7), images  # never seen: 0
    weights = masks.soft_weights(
        request.scene.means,
        evidence.inside,
        evidence.total,
        min_evidence=config.min_evidence,
        neighbours=config.neighbours,
    )
    return weights, images


def sum_evidence(config: MaskConfig, request: MaskRequest, images: dict[int, UInt8[Tensor, "H W"]]) -> Evidence:
    """What pictures by number of view say of the splats, by the vote that the config names."""
    zeros = request.scene.means.new_zeros(len(request.scene))
    evidence = Evidence(zeros, zeros)
    for view, image in images.items():
        arguments = request.scene, request.cameras[view], [image.float() / 255]
        if config.vote == "weighted":
            evidence += lift(*arguments, backend=request.backend, antialiased=request.antialiased)
        else:
            evidence += vote(*arguments, antialiased=request.antialiased)
    return evidence
