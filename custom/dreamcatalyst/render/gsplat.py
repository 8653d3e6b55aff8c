"""The CUDA rasterizer: the `gsplat` package (Ye et al. 2024) behind the same door, imported only when it is used."""

from __future__ import annotations

import importlib
import importlib.util
import re
import shutil
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from .. import plugin
from ..data.camera import Cameras
from ..errors import SceneError
from ..scene.gaussians import Gaussians
from . import reference, sh
from .api import Backend, Render, RenderOptions
from .thresholds import BLUR, NEAR

# Which versions draw this image model (thresholds.py): earlier ones cut splats at 3 standard deviations (1.4) or lack a
# header that they compile with (1.5.1, 1.5.2); 1.6 caps alpha elsewhere.
FROM, BEFORE = (1, 5, 3), (1, 6)
INSTALL = "pip install 'gsplat>=1.5.3,<1.6'"
SMALLEST_NORM = 1e-12  # of quaternions; a smaller one is the identity, as in projection.rotations


def rasterize(scene: Gaussians, cameras: Cameras, options: RenderOptions) -> Render:
    """Draw `scene`; arguments and result as in `api.rasterize`. Raises SceneError where gsplat is not installed."""
    if len(scene) == 0:  # gsplat divides by the number of splats
        return reference.rasterize(scene, cameras, options)
    image, alpha, meta = package().rasterization(**arguments(scene, cameras, options))
    features, radii = options.features, meta["radii"]
    return Render(
        rgb=image[..., :3],
        alpha=alpha,
        depth=image[..., -1:] if options.depth else None,
        features=None if features is None else image[..., 3 : 3 + features.shape[1]],
        means2d=meta["means2d"],
        radii=radii.amax(dim=-1).int(),  # gsplat gives one radius per axis
    )


def arguments(scene: Gaussians, cameras: Cameras, options: RenderOptions) -> dict[str, Any]:
    """The arguments of `gsplat.rasterization` that draw the same images. Colours are evaluated here, so that features
    ride along as further channels [V,N,3+F] over a zero background; depth comes last, divided by alpha (mode ED)."""
    views = len(cameras)
    channels = sh.colors(scene.means, cameras.centers, scene.sh0, scene.shN, options.sh_degree)
    background, features = options.background, options.features
    if features is not None:
        channels = torch.cat([channels, features.expand(views, -1, -1)], dim=-1)
        background = torch.cat([background, background.new_zeros(features.shape[1])])
    return dict(
        means=scene.means,
        quats=turned(scene.quats),
        scales=scene.scales,
        opacities=scene.opacities,
        colors=channels,
        viewmats=cameras.viewmats,
        Ks=cameras.Ks,
        width=cameras.width,
        height=cameras.height,
        near_plane=NEAR,
        eps2d=BLUR,
        packed=False,
        backgrounds=background.expand(views, -1),
        render_mode="RGB+ED" if options.depth else "RGB",
        rasterize_mode="antialiased" if options.antialiased else "classic",
    )


def turned(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 4"]:
    """Quaternions [N,4] of which none is zero, since gsplat's kernel divides by their norm: the identity instead,
    without gradient."""
    zero = torch.linalg.vector_norm(quats.detach(), dim=-1, keepdim=True) < SMALLEST_NORM
    return torch.where(zero, torch.eye(1, 4, dtype=quats.dtype, device=quats.device), quats)


def package() -> ModuleType:
    """The module gsplat. Raises SceneError where it cannot be imported or is of a version that was not tested."""
    try:
        import gsplat
    except ImportError as error:
        raise SceneError(
            "rasterize: backend 'gsplat' needs the package gsplat, which cannot be imported. Install it with "
            f'"{INSTALL}", or run on the CPU: trainer.accelerator=cpu. ({error})'
        ) from error
    version = tuple(int(number) for number in re.findall(r"\d+", gsplat.__version__)[:3])
    if not FROM <= version < BEFORE:
        raise SceneError(
            f"rasterize: backend 'gsplat' found gsplat {gsplat.__version__}, expected 1.5.3 or later and before 1.6: "
            f'others draw other images of the same splats. Install one with "{INSTALL}".'
        )
    return gsplat


def prepare() -> None:
    """Load gsplat's kernels, and say so where they have to be compiled first (minutes, once). Raises SceneError where
    gsplat is absent or of another version, and where there is nothing that compiles."""
    package()
    if not compiled():
        missing = [name for name, there in compilers().items() if not there]
        if missing:
            raise SceneError(
                "rasterize: backend 'gsplat' has to compile its kernels, once, and this machine lacks "
                f"{', '.join(missing)}. Install the CUDA toolkit of this torch ({torch.version.cuda}) and a C++ "
                "compiler, or a gsplat that is compiled (https://docs.gsplat.studio/whl), or run on the CPU: "
                "trainer.accelerator=cpu"
            )
        plugin.info("gsplat compiles its kernels: this takes minutes, and happens once")
    try:
        kernels = importlib.import_module("gsplat.cuda._backend")._C
    except (RuntimeError, ImportError, OSError) as error:  # of the compiler, the linker, the loader
        last = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        raise SceneError(
            "rasterize: backend 'gsplat' cannot compile or load its kernels. See what \"python -c 'import "
            f"gsplat.cuda._backend'\" says, or run on the CPU: trainer.accelerator=cpu. ({last})"
        ) from error
    if kernels is None:
        raise SceneError(
            "rasterize: backend 'gsplat' finds no CUDA toolkit to compile its kernels with. Set CUDA_HOME to it, or "
            "run on the CPU: trainer.accelerator=cpu"
        )


def compiled() -> bool:
    """Whether gsplat's kernels are there: in the package itself, or where torch keeps what it has compiled."""
    from torch.utils import cpp_extension

    if importlib.util.find_spec("gsplat.csrc") is not None:
        return True
    folder = Path(cpp_extension._get_build_directory("gsplat_cuda", verbose=False))  # as gsplat itself asks
    return any((folder / f"gsplat_cuda.{suffix}").is_file() for suffix in ("so", "pyd", "lib"))


def compilers() -> dict[str, bool]:
    """What compiling takes, and whether it is there."""
    from torch.utils import cpp_extension

    home = cpp_extension.CUDA_HOME
    nvcc = bool(shutil.which("nvcc")) or (home is not None and (Path(home) / "bin" / "nvcc").is_file())
    return {
        "nvcc": nvcc,
        "a C++ compiler": bool(shutil.which(cpp_extension.get_cxx_compiler())),
        "ninja": cpp_extension.is_ninja_available(),
    }


BACKEND = Backend("gsplat", rasterize, devices=("cuda",), dtypes=(torch.float32,), prepare=prepare)
