"""Pinhole cameras in batches: what every renderer, dataset and trajectory speaks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import DataError


@dataclass(frozen=True)
class Cameras:
    """V pinhole cameras of one image size.

    viewmats [V,4,4]: world to camera, OpenCV axes (x right, y down, z forward), world units.
    Ks [V,3,3]: intrinsics in pixels, pixel centres at +0.5; the principal point is free.
    width, height: pixels.
    """

    viewmats: Float[Tensor, "V 4 4"]
    Ks: Float[Tensor, "V 3 3"]
    width: int
    height: int

    def __post_init__(self) -> None:
        v, got = self.viewmats.shape[0], (tuple(self.viewmats.shape), tuple(self.Ks.shape))
        if got != ((v, 4, 4), (v, 3, 3)):
            raise DataError(f"cameras: viewmats {got[0]} and Ks {got[1]} must be [V,4,4] and [V,3,3]")
        if self.width < 1 or self.height < 1:
            raise DataError(f"cameras: image size {self.width}x{self.height} must be at least 1x1")

    def __len__(self) -> int:
        return self.viewmats.shape[0]

    def __getitem__(self, index: int | slice | list[int] | Tensor) -> Cameras:
        """The cameras at `index`, always a batch (an int gives a batch of one)."""
        if isinstance(index, int):
            index = [index]
        return replace(self, viewmats=self.viewmats[index], Ks=self.Ks[index])

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Cameras:
        """The same cameras on another device or in another precision."""
        return replace(self, viewmats=self.viewmats.to(device, dtype), Ks=self.Ks.to(device, dtype))

    @property
    def centers(self) -> Float[Tensor, "V 3"]:
        """Camera centres in the world, [V,3] world units. The rotation part is taken as orthonormal."""
        rotation, translation = self.viewmats[:, :3, :3], self.viewmats[:, :3, 3]
        return -(rotation.transpose(1, 2) @ translation[:, :, None])[:, :, 0]

    @property
    def forward(self) -> Float[Tensor, "V 3"]:
        """Unit viewing directions in the world, [V,3]."""
        return self.viewmats[:, 2, :3]

    def resized(self, width: int, height: int) -> Cameras:
        """The same views drawn at another size; intrinsics are scaled per axis."""
        scale = self.Ks.new_tensor([width / self.width, height / self.height, 1.0])
        return replace(self, Ks=self.Ks * scale[None, :, None], width=width, height=height)

    def cropped(self, left: int, top: int, width: int, height: int) -> Cameras:
        """The window of `width` x `height` pixels whose upper left corner is at (left, top)."""
        shift = torch.zeros_like(self.Ks)
        shift[:, 0, 2], shift[:, 1, 2] = left, top
        return replace(self, Ks=self.Ks - shift, width=width, height=height)

    @staticmethod
    def cat(parts: list[Cameras]) -> Cameras:
        """One batch of all the given cameras, which must share one image size."""
        sizes = {(c.width, c.height) for c in parts}
        if len(sizes) != 1:
            found = ", ".join(f"{width}x{height}" for width, height in sorted(sizes)) or "none"
            raise DataError(
                f"cameras of different image sizes cannot be one batch: {found}. Set data.width and data.height"
            )
        return replace(parts[0], viewmats=torch.cat([c.viewmats for c in parts]), Ks=torch.cat([c.Ks for c in parts]))


def look_at(
    eye: Float[Tensor, "V 3"], target: Float[Tensor, "*#V 3"], up: Float[Tensor, " 3"]
) -> Float[Tensor, "V 4 4"]:
    """World-to-camera matrices [V,4,4] of cameras at `eye` [V,3] that look at `target` [V,3] or [3].

    up [3]: the world direction that is up in the image; where it is parallel to the view, another axis takes its place.
    """
    eye, target, up = torch.broadcast_tensors(eye, target, up)
    z = torch.nn.functional.normalize(target - eye, dim=-1)
    x = torch.linalg.cross(z, up, dim=-1)
    degenerate = x.norm(dim=-1, keepdim=True) < 1e-6 * up.norm(dim=-1, keepdim=True)
    spare = torch.where(z[..., :1].abs() < 0.9, up.new_tensor([1.0, 0, 0]), up.new_tensor([0, 1.0, 0]))
    x = torch.nn.functional.normalize(torch.where(degenerate, torch.linalg.cross(z, spare, dim=-1), x), dim=-1)
    y = torch.linalg.cross(z, x, dim=-1)
    rotation = torch.stack([x, y, z], dim=-2)
    out = torch.eye(4, dtype=eye.dtype, device=eye.device).repeat(eye.shape[0], 1, 1)
    out[:, :3, :3] = rotation
    out[:, :3, 3] = -(rotation @ eye[:, :, None])[:, :, 0]
    return out
