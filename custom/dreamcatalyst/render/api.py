"""The one door to rendering: `rasterize`, whatever draws it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import attrgetter

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from ..cache import ByteCache
from ..data.camera import Cameras
from ..errors import SceneError
from ..registry import Registry
from ..scene.gaussians import Gaussians

BACKENDS = Registry("rasterizer backend", __package__)
BACKENDS.add("reference", ".reference:BACKEND")
BACKENDS.add("cpu", ".cpu.api:BACKEND")
BACKENDS.add("gsplat", ".gsplat:BACKEND")


@dataclass(frozen=True)
class Render:
    """What one call draws, for V views.

    rgb [V,H,W,3] unclamped, over the background; alpha [V,H,W,1] in [0,1];
    depth [V,H,W,1] expected z of what is there (world units, 0 where alpha is 0), None unless asked for;
    features [V,H,W,F] composited like colour over zero, None unless given;
    means2d [V,N,2] pixels: a node of the graph whose gradient drives densification (call retain_grad). Beside frozen
    splats it may be a leaf that only receives that gradient;
    radii [V,N] int32 pixels, 0 where the splat is not drawn.
    """

    rgb: Float[Tensor, "V H W 3"]
    alpha: Float[Tensor, "V H W 1"]
    depth: Float[Tensor, "V H W 1"] | None
    features: Float[Tensor, "V H W F"] | None
    means2d: Float[Tensor, "V N 2"]
    radii: Int32[Tensor, "V N"]


@dataclass(frozen=True)
class RenderOptions:
    """How a backend draws N splats: what `rasterize` was given or chose, of the splats' type and on their device.

    background [3]; sh_degree: bases above it are left out; features [N,F] to composite over zero, None for none; depth:
    whether it is asked for; antialiased: whether opacity is scaled by what the blur adds to a splat's area.
    """

    background: Float[Tensor, " 3"]
    sh_degree: int
    features: Float[Tensor, "N F"] | None
    depth: bool
    antialiased: bool


class Frozen:
    """F splats without gradient, drawn together with those that are edited (`rasterize(..., frozen=)`).

    kept: what a backend keeps per view (a tile's list, an image), by everything that it depends on; anything that says
    how many `nbytes` it takes, at most `limit` bytes in all. A limit of 0 keeps nothing.
    scene shares memory with the splats given, which must not be changed in place. len() is F.
    """

    def __init__(self, scene: Gaussians, limit: int = 2**30):
        self.scene = scene.detach()
        self.kept = ByteCache(limit, size=attrgetter("nbytes"))

    def __len__(self) -> int:
        return len(self.scene)


@dataclass(frozen=True)
class Backend:
    """One way to draw, and what it can: all who choose a backend ask here.

    draw(scene, cameras, options): a Render of splats that `check` lets through, by RenderOptions. devices, dtypes: what
    it takes (types of torch.device), empty for any. keeps_frozen: draw takes `frozen` itself as a fourth, for colour
    alone, and keeps of it what does not change; others are given all splats in one scene. prepare: makes sure that it
    can draw at all on this machine, before a run loads anything, and does what takes long; raises SceneError with the
    remedy where it cannot.
    """

    name: str
    draw: Callable[..., Render]
    devices: tuple[str, ...] = ()
    dtypes: tuple[torch.dtype, ...] = ()
    keeps_frozen: bool = False
    prepare: Callable[[], None] | None = None

    def takes(self, device: torch.device, dtype: torch.dtype) -> bool:
        """Whether it can draw splats of this kind."""
        return device.type in (self.devices or [device.type]) and dtype in (self.dtypes or [dtype])

    def check(self, device: torch.device, dtype: torch.dtype) -> None:
        """Raise SceneError where it cannot draw splats of this kind."""
        if self.takes(device, dtype):
            return
        others = ", ".join(backend.name for backend in BACKENDS.parts() if backend.takes(device, dtype))
        where, kind = (self.devices or [device.type])[0], (self.dtypes or [dtype])[0]
        raise SceneError(
            f"rasterize: backend '{self.name}' got {dtype} splats on {device}, expected {kind} on {where}. Convert "
            f"them with .to('{where}', {kind}), or choose a backend that takes them: {others}; 'auto' chooses."
        )


def find_backend(name: str, device: torch.device, dtype: torch.dtype = torch.float32) -> Backend:
    """The backend called `name`, or that which "auto" chooses for splats of this kind: gsplat for those on a GPU, cpu
    for the others, reference for float64 on the CPU. Raises ConfigError for an unknown name, and SceneError where it
    cannot draw them."""
    if name == "auto":
        on_cpu = device.type == "cpu"
        name = ("reference" if dtype == torch.float64 else "cpu") if on_cpu else "gsplat"
    backend = BACKENDS.get(name, "renderer.backend")
    backend.check(device, dtype)
    return backend


def rasterize(
    scene: Gaussians,
    cameras: Cameras,
    *,
    background: Tensor | None = None,
    sh_degree: int | None = None,
    features: Tensor | None = None,
    depth: bool = False,
    antialiased: bool = False,
    backend: str = "auto",
    frozen: Frozen | None = None,
) -> Render:
    """Alpha-composite Gaussians front to back into V images.

    scene: N splats, N >= 0. cameras: V cameras of one size. background [3] in [0,1], black by default.
    sh_degree: bases above it are left out (default: all that the scene has). features [N,F]: any further channels.
    antialiased: opacity is scaled by sqrt(det(cov) / det(cov + 0.3 I)), as in Mip-Splatting's 2D filter.
    backend: reference | cpu | gsplat, or auto (gsplat for splats on a GPU, cpu otherwise; float64 takes reference).
    frozen: F further splats that stand before those of `scene` and take no derivative; `features` is then [F+N,F'], and
    `means2d` and `radii` are those of `scene` alone. What the backend keeps of them makes the next call faster.
    Differentiable in every parameter of `scene`, in `background` and in `features`; not in `cameras`. Autocast is off
    inside, so that positions keep their digits; backward belongs outside of it, too, as everywhere in torch.
    Source: Kerbl et al. 2023, sections 4-6. Raises SceneError where arguments disagree in size, dtype or device.
    """
    if background is None:
        background = scene.means.new_zeros(3)
    if background.shape != (3,):
        raise SceneError(f"rasterize: background has shape {tuple(background.shape)}, expected (3,)")
    rows = len(scene)
    if frozen is not None:
        _check(scene, frozen.scene)
        rows += len(frozen)
    if features is not None and (features.ndim != 2 or len(features) != rows):
        raise SceneError(f"rasterize: features have shape {tuple(features.shape)}, expected ({rows}, F)")
    if sh_degree is not None and not 0 <= sh_degree <= scene.sh_degree:
        raise SceneError(f"rasterize: sh_degree {sh_degree} asked of splats that have degree {scene.sh_degree}")
    drawer = find_backend(backend, scene.means.device, scene.means.dtype)
    with torch.autocast(scene.means.device.type, enabled=False):
        cameras = cameras.to(scene.means.device, scene.means.dtype)
        options = RenderOptions(
            background=background.to(scene.means),
            sh_degree=scene.sh_degree if sh_degree is None else sh_degree,
            features=None if features is None else features.to(scene.means),
            depth=depth,
            antialiased=antialiased,
        )
        if frozen is None:
            return drawer.draw(scene, cameras, options)
        if drawer.keeps_frozen and features is None and not depth:
            return drawer.draw(scene, cameras, options, frozen)
        whole = Gaussians.cat([replace(part, extra={}) for part in (frozen.scene, scene)])
        render = drawer.draw(whole, cameras, options)
        return replace(render, means2d=_tail(render.means2d, len(frozen)), radii=render.radii[:, len(frozen) :])


def _check(scene: Gaussians, frozen: Gaussians) -> None:
    """Raise SceneError where the two cannot be drawn as one."""
    kinds = [(f"SH degree {s.sh_degree}", f"{s.means.dtype} on {s.means.device}") for s in (scene, frozen)]
    for got, want in zip(*kinds, strict=True):
        if got != want:
            raise SceneError(
                f"rasterize: frozen splats have {want}, the edited ones {got}, expected the same. "
                "Take both from one scene, or convert the frozen ones with .to(device, dtype)."
            )


def _tail(means2d: Float[Tensor, "V N 2"], first: int) -> Float[Tensor, "V M 2"]:
    """The means2d of the splats from `first` on. A slice would lie beside the way from the loss to the parameters and
    see no gradient; this leaf is handed the part of it that arrives at the whole."""
    tail = means2d[:, first:].detach().requires_grad_(means2d.requires_grad)

    def receive(grad: Tensor) -> None:
        arrived = grad[:, first:]
        tail.grad = arrived.clone() if tail.grad is None else tail.grad + arrived

    if means2d.requires_grad:
        means2d.register_hook(receive)
    return tail
