"""The scene: N anisotropic Gaussians with the raw parameters of 3DGS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from ..errors import SceneError

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))
PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")


@dataclass(frozen=True)
class Gaussians:
    """N splats, raw (unconstrained) parameters as in Kerbl et al. 2023.

    means [N,3] world units; quats [N,4] wxyz, any norm; log_scales [N,3] log of world units; logit_opacities [N];
    sh0 [N,1,3] and shN [N,(d+1)^2-1,3]: SH coefficients, colour = 0.5 + sum, d = 0..3.
    extra: per-splat tensors [N,...] that ride along (a mask, a generation, a property read from a file).
    Raises SceneError where the fields disagree in N, dtype or device.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    log_scales: Float[Tensor, "N 3"]
    logit_opacities: Float[Tensor, " N"]
    sh0: Float[Tensor, "N 1 3"]
    shN: Float[Tensor, "N K 3"]
    extra: dict[str, Shaped[Tensor, "N ..."]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        shapes = dict(means=(n, 3), quats=(n, 4), log_scales=(n, 3), logit_opacities=(n,), sh0=(n, 1, 3))
        for name, shape in shapes.items():
            got = tuple(getattr(self, name).shape)
            if got != shape:
                raise SceneError(f"splats: {name} has shape {got}, expected {shape}")
        k = self.shN.shape[1] if self.shN.ndim == 3 else -1
        if self.shN.shape != (n, k, 3) or k not in (0, 3, 8, 15):
            raise SceneError(f"splats: shN has shape {tuple(self.shN.shape)}, expected ({n}, 0|3|8|15, 3)")
        for name, value in self.extra.items():
            if value.shape[:1] != (n,):
                raise SceneError(f"splats: extra '{name}' has {tuple(value.shape)}, expected {n} rows")
        for name in PARAMETERS[1:]:
            value = getattr(self, name)
            if value.dtype != self.means.dtype or value.device != self.means.device:
                got, want = (f"{v.dtype} on {v.device}" for v in (value, self.means))
                raise SceneError(f"splats: {name} is {got}, means is {want}")

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def scales(self) -> Float[Tensor, "N 3"]:
        """[N,3] world units."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, " N"]:
        """[N] in (0,1)."""
        return self.logit_opacities.sigmoid()

    @property
    def sh(self) -> Float[Tensor, "N K 3"]:
        """[N,(d+1)^2,3], a copy."""
        return torch.cat([self.sh0, self.shN], dim=1)

    @property
    def sh_degree(self) -> int:
        """0 to 3, as the tensors hold it."""
        return {0: 0, 3: 1, 8: 2, 15: 3}[self.shN.shape[1]]

    def parameters(self) -> Iterator[tuple[str, Tensor]]:
        """(name, tensor) of the six raw parameters, in the order of PARAMETERS."""
        return ((name, getattr(self, name)) for name in PARAMETERS)

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """Apply `function` to every per-splat tensor, extras included."""
        done = {f.name: function(getattr(self, f.name)) for f in fields(self) if f.name != "extra"}
        return Gaussians(**done, extra={k: function(v) for k, v in self.extra.items()})

    def __getitem__(self, index: Tensor | slice) -> Gaussians:
        """The splats at `index` (bool mask [N], indices or slice)."""
        return self.map(lambda tensor: tensor[index])

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Gaussians:
        """The same splats elsewhere; extras keep their own dtype."""
        moved = {name: value.to(device, dtype) for name, value in self.parameters()}
        return Gaussians(**moved, extra={k: v.to(device) for k, v in self.extra.items()})

    def detach(self) -> Gaussians:
        """The same tensors without graph."""
        return self.map(torch.Tensor.detach)

    def clone(self) -> Gaussians:
        """A copy that shares no memory."""
        return self.map(torch.Tensor.clone)

    def with_extra(self, **extra: Shaped[Tensor, "N ..."]) -> Gaussians:
        """The same splats with these extras added or replaced."""
        return replace(self, extra={**self.extra, **extra})

    @staticmethod
    def cat(parts: list[Gaussians]) -> Gaussians:
        """All splats of `parts` in order. SH degrees and extras must agree; raises SceneError where they do not."""
        degrees, extras = {p.sh_degree for p in parts}, {tuple(sorted(p.extra)) for p in parts}
        if len(degrees) > 1 or len(extras) > 1:
            raise SceneError(f"splats: cannot join scenes of SH degrees {sorted(degrees)} with extras {sorted(extras)}")
        joined = {name: torch.cat([getattr(p, name) for p in parts]) for name in PARAMETERS}
        return Gaussians(**joined, extra={k: torch.cat([p.extra[k] for p in parts]) for k in parts[0].extra})

    @staticmethod
    def from_colors(
        means: Float[Tensor, "N 3"],
        scales: Float[Tensor, "N 3"],
        colors: Float[Tensor, "N 3"],
        opacities: Float[Tensor, " N"],
        quats: Float[Tensor, "N 4"] | None = None,
        sh_degree: int = 0,
    ) -> Gaussians:
        """Splats of plain colours. scales [N,3] world units, colors [N,3] in [0,1], opacities [N] in (0,1)."""
        n = means.shape[0]
        if quats is None:
            quats = means.new_tensor([1.0, 0, 0, 0]).repeat(n, 1)
        sh0 = ((colors - 0.5) / SH_C0)[:, None, :]
        shN = means.new_zeros(n, (sh_degree + 1) ** 2 - 1, 3)
        return Gaussians(means, quats, scales.log(), torch.logit(opacities), sh0, shN)
