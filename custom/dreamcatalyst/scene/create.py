"""Splats made of points and meshes, to be fitted or edited from there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import SceneError
from .gaussians import Gaussians

GREY = 0.5  # the colour of a surface that has none


def from_points(
    xyz: Float[Tensor, "P 3"], rgb: Float[Tensor, "P 3"], sh_degree: int = 3, initial_opacity: float = 0.1
) -> Gaussians:
    """Round splats at points, as 3DGS begins: scale = root mean square distance to the 3 nearest other points.

    xyz [P,3] world units, rgb [P,3] in [0,1]; float32 splats on the points' device. Points that coincide would get
    scale 0: scales are kept above 1/1000 of their median (of 1 world unit where all coincide or P = 1).
    Source: Kerbl et al. 2023, section 5.1, and its code (opacity 0.1). Raises SceneError without finite points.
    """
    if xyz.ndim != 2 or xyz.shape[1] != 3 or rgb.shape != xyz.shape:
        raise SceneError(f"points: xyz {tuple(xyz.shape)} and rgb {tuple(rgb.shape)} must both be [P,3]")
    if xyz.shape[0] == 0:
        raise SceneError("points: none to make splats of; the reconstruction or point cloud is empty")
    if not bool(xyz.isfinite().all() and rgb.isfinite().all()):
        bad = int((~(xyz.isfinite() & rgb.isfinite()).all(dim=1)).sum())
        raise SceneError(f"points: {bad} of {xyz.shape[0]} are NaN or infinite; remove them first")
    scales = torch.from_numpy(neighbour_distance(xyz.detach().cpu().double().numpy())).to(xyz.device)
    positive = scales[scales > 0]
    scales = scales.clamp_min(1e-3 * float(positive.median() if len(positive) else 1.0))
    return Gaussians.from_colors(
        means=xyz.float(),
        scales=scales.float()[:, None].repeat(1, 3),
        colors=rgb.float(),
        opacities=torch.full_like(xyz[:, 0], initial_opacity, dtype=torch.float32),
        sh_degree=sh_degree,
    )


def neighbour_distance(xyz: Float[np.ndarray, "P 3"], k: int = 3) -> Float[np.ndarray, " P"]:
    """Root mean square distance [P] of each point to its `k` nearest others, or to all others; 0 for P = 1."""
    from scipy.spatial import KDTree

    k = min(k, len(xyz) - 1)
    if k == 0:
        return np.zeros(len(xyz))
    distances, _ = KDTree(xyz).query(xyz, k=k + 1, workers=-1)
    return np.sqrt((distances[:, 1:] ** 2).mean(axis=1))  # column 0 is the point itself, or one that coincides


def from_mesh(
    path: str | Path, n: int, seed: int = 0, *, sh_degree: int = 0, initial_opacity: float = 0.9
) -> Gaussians:
    """`n` splats spread evenly over the surfaces of a mesh, or over the points of a point cloud.

    Reads what trimesh reads (OBJ, PLY, GLB, STL, OFF ...); all parts of a scene, placed. Colours come from the texture,
    the vertices or the faces, else they are grey. A point cloud of no more than n points is taken whole.
    Raises SceneError: no such file, a file that trimesh cannot read, nothing with a surface or points in it.
    """
    path = Path(path)
    if n < 1:
        raise SceneError(f"{path}: asked for {n} splats, expected at least 1")
    rng = np.random.default_rng(seed)
    meshes, clouds = _geometry(path)
    if meshes:
        areas = np.array([mesh.area for mesh in meshes])
        if not areas.sum() > 0:
            raise SceneError(f"{path}: its {sum(len(m.faces) for m in meshes)} faces have no area")
        counts = rng.multinomial(n, areas / areas.sum())
        parts = [sample_surface(mesh, count, rng) for mesh, count in zip(meshes, counts.tolist(), strict=True)]
    else:
        parts = [(np.asarray(cloud.vertices), _unit(cloud.colors, len(cloud.vertices))) for cloud in clouds]
    xyz, rgb = (np.concatenate(column) for column in zip(*parts, strict=True))
    if len(xyz) > n:
        chosen = np.sort(rng.choice(len(xyz), n, replace=False))
        xyz, rgb = xyz[chosen], rgb[chosen]
    return from_points(torch.from_numpy(xyz).float(), torch.from_numpy(rgb).float(), sh_degree, initial_opacity)


def sample_surface(mesh, n: int, rng: np.random.Generator) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """`n` points uniform over the area of a trimesh mesh, and their colours: xyz [n,3], rgb [n,3] in [0,1]."""
    faces = rng.choice(len(mesh.faces), n, p=mesh.area_faces / mesh.area)
    weights = rng.dirichlet((1.0, 1.0, 1.0), n)  # uniform over the triangle
    corners = mesh.faces[faces]

    def blend(values: np.ndarray) -> np.ndarray:
        return np.einsum("nc,ncd->nd", weights, values[corners])

    visual = mesh.visual
    if visual.kind == "texture" and visual.uv is not None:
        rgb = _unit(visual.material.to_color(blend(np.asarray(visual.uv))), n)
    elif visual.kind == "vertex":
        rgb = blend(_unit(visual.vertex_colors, len(mesh.vertices)))
    elif visual.kind == "face":
        rgb = _unit(visual.face_colors, len(mesh.faces))[faces]
    else:
        rgb = np.full((n, 3), GREY)
    return blend(mesh.vertices), rgb


def _geometry(path: Path) -> tuple[list, list]:
    """The meshes with faces and the point clouds of a file, placed in its world."""
    import trimesh

    if not path.is_file():
        raise SceneError(f"{path}: no such file, expected a mesh or point cloud (OBJ, PLY, GLB, STL ...)")
    try:
        loaded = trimesh.load_scene(path).dump()
    except Exception as error:  # each of trimesh's readers raises its own kinds
        raise SceneError(f"{path}: trimesh cannot read it ({type(error).__name__}: {error})") from error
    meshes = [part for part in loaded if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    clouds = [part for part in loaded if isinstance(part, trimesh.PointCloud) and len(part.vertices)]
    if not meshes and not clouds:
        raise SceneError(f"{path}: holds no faces and no points")
    return meshes, clouds


def _unit(colors: np.ndarray | None, n: int) -> np.ndarray:
    """RGB(A) of 0..255 as RGB [n,3] in [0,1]; grey where there are none."""
    colors = np.asarray(colors)
    return colors[:, :3] / 255.0 if colors.shape[:1] == (n,) and colors.ndim == 2 else np.full((n, 3), GREY)
