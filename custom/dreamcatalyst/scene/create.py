"""Splats made of points and meshes, to be fitted or edited from there."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import SceneError
from .gaussians import Gaussians
from .place import frames

GREY = 0.5  # the colour of a surface that has none
SOLID, CLEAR = 0.95, 0.05  # opacity of a surface that is not clear; alpha below which there is none
TOUCHING = 0.6  # a splat's standard deviation over the distance of its neighbours, of a closed surface
THIN = 0.12  # thickness of a flat splat over its width
R2 = np.array([0.7548776662466927, 0.5698402909980532])  # powers of 1 / 1.32471795..., the root of x^3 = x + 1


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
        counts = rng.multinomial(n, areas / _area(path, meshes))
        parts = [sample_surface(mesh, count, rng) for mesh, count in zip(meshes, counts.tolist(), strict=True)]
    else:
        parts = [(np.asarray(cloud.vertices), _unit(cloud.colors, len(cloud.vertices))) for cloud in clouds]
    xyz, rgb = (np.concatenate(column) for column in zip(*parts, strict=True))
    if len(xyz) > n:
        chosen = np.sort(rng.choice(len(xyz), n, replace=False))
        xyz, rgb = xyz[chosen], rgb[chosen]
    return from_points(torch.from_numpy(xyz).float(), torch.from_numpy(rgb).float(), sh_degree, initial_opacity)


def flat_splats(path: str | Path, n: int, seed: int = 0) -> tuple[Gaussians, bool]:
    """About `n` splats that show a mesh as it looks, flat on its surface and closed, and whether there is a surface.

    Colours, and opacity where they have an alpha, as in `from_mesh`; what is clear is left out. Of a point cloud: round
    splats that touch. Raises SceneError as `from_mesh`, and where positions are not finite or all is clear.
    """
    path = Path(path)
    if n < 1:
        raise SceneError(f"{path}: asked for {n} splats, expected at least 1")
    meshes, clouds = _geometry(path)
    if not meshes:
        xyz, rgba = cloud_points(path, clouds, n, np.random.default_rng(seed))
        points, kept = torch.from_numpy(xyz).float(), torch.from_numpy(rgba[:, 3] > CLEAR)
        _require_some(path, kept)
        round_ones = from_points(points[kept], torch.from_numpy(rgba[:, :3]).float()[kept], 0, SOLID)
        return replace(round_ones, log_scales=round_ones.log_scales + math.log(TOUCHING)), False
    area = _area(path, meshes)
    spacing = math.sqrt(area / n)
    made = []
    for mesh in meshes:
        count = round(n * mesh.area / area)
        if count:
            made.append(even_surface(mesh, count, seed))
    xyz, normals, rgba = (np.concatenate(column) for column in zip(*made, strict=True))
    kept = torch.from_numpy(rgba[:, 3] > CLEAR)
    _require_some(path, kept)
    widths = np.clip(TOUCHING * neighbour_distance(xyz, 4), 0.4 * spacing, 1.5 * spacing)
    scales = torch.from_numpy(np.stack([widths, widths, THIN * widths], axis=1)).float()
    return Gaussians.from_colors(
        means=torch.from_numpy(xyz).float(),
        scales=scales,
        colors=torch.from_numpy(rgba[:, :3]).float(),
        opacities=torch.from_numpy(SOLID * rgba[:, 3].clip(CLEAR, 1)).float(),
        quats=frames(torch.from_numpy(normals).float()),
    )[kept], True


def even_surface(mesh, n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`n` points spread evenly over a trimesh mesh, without clumps: xyz [n,3], normals [n,3], RGBA [n,4] in [0,1].

    Each takes the same area, face by face; within a face they follow a sequence that fills it evenly (Roberts' R2).
    """
    ends = np.cumsum(mesh.area_faces)
    faces = np.searchsorted(ends, (np.arange(n) + 0.5) / n * ends[-1]).clip(max=len(ends) - 1)
    uv = (np.random.default_rng(seed).random(2) + np.outer(np.arange(n), R2)) % 1.0
    uv = np.where(uv.sum(axis=1, keepdims=True) > 1, 1 - uv, uv)  # of the square's other half
    weights = np.column_stack([1 - uv.sum(axis=1), uv])
    normals = np.asarray(mesh.face_normals)[faces]
    return np.einsum("nc,ncd->nd", weights, mesh.vertices[mesh.faces[faces]]), normals, _rgba(mesh, faces, weights)


def cloud_points(path: Path, clouds: list, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points of point clouds, n of them at most, and their RGBA [P,4] in [0,1]."""
    xyz = np.concatenate([np.asarray(cloud.vertices) for cloud in clouds])
    rgba = np.concatenate([_unit_rgba(cloud.colors, len(cloud.vertices)) for cloud in clouds])
    bad = int((~np.isfinite(xyz).all(axis=1)).sum())
    if bad:
        raise SceneError(f"{path}: {bad} of {len(xyz)} points are NaN or infinite; remove them first")
    chosen = np.sort(rng.choice(len(xyz), n, replace=False)) if len(xyz) > n else slice(None)
    return xyz[chosen], rgba[chosen]


def sample_surface(mesh, n: int, rng: np.random.Generator) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """`n` points uniform over the area of a trimesh mesh, and their colours: xyz [n,3], rgb [n,3] in [0,1]."""
    faces = rng.choice(len(mesh.faces), n, p=mesh.area_faces / mesh.area)
    weights = rng.dirichlet((1.0, 1.0, 1.0), n)  # uniform over the triangle
    xyz = np.einsum("nc,ncd->nd", weights, mesh.vertices[mesh.faces[faces]])
    return xyz, _rgba(mesh, faces, weights)[:, :3]


def _rgba(mesh, faces: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """RGBA [n,4] in [0,1] at points of a mesh: of its texture, material, vertices or faces; else grey."""
    corners, n, visual = mesh.faces[faces], len(faces), mesh.visual
    if visual.kind == "texture":
        material = visual.material
        if visual.uv is None or not _pictured(material):
            return np.tile(_unit_rgba(np.asarray(material.main_color)[None], 1), (n, 1))
        uv = np.einsum("nc,ncd->nd", weights, np.asarray(visual.uv)[corners])
        return _unit_rgba(material.to_color(uv), n)  # alone: many files have a factor beside it that nobody meant
    if visual.kind == "vertex":
        return np.einsum("nc,ncd->nd", weights, _unit_rgba(visual.vertex_colors, len(mesh.vertices))[corners])
    if visual.kind == "face":
        return _unit_rgba(visual.face_colors, len(mesh.faces))[faces]
    return np.tile([GREY, GREY, GREY, 1.0], (n, 1))


def _pictured(material) -> bool:
    """Whether a material has a texture of its colours."""
    return getattr(material, "image", None) is not None or getattr(material, "baseColorTexture", None) is not None


def _area(path: Path, meshes: list) -> float:
    """Of all their faces. Raises SceneError where there is none, or where it is not finite."""
    area = sum(float(mesh.area) for mesh in meshes)
    faces = sum(len(mesh.faces) for mesh in meshes)
    if not math.isfinite(area):
        raise SceneError(f"{path}: some of its {faces} faces have corners that are NaN or infinite; remove them first")
    if not area > 0:
        raise SceneError(f"{path}: its {faces} faces have no area")
    return area


def _require_some(path: Path, kept: Tensor) -> None:
    if not bool(kept.any()):
        raise SceneError(f"{path}: all of it is clear: the alpha of its colours is 0")


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
    return _unit_rgba(colors, n)[:, :3]


def _unit_rgba(colors: np.ndarray | None, n: int) -> np.ndarray:
    """RGB(A) of 0..255 as RGBA [n,4] in [0,1]; grey where there are none."""
    colors = np.asarray(colors)
    if colors.shape[:1] != (n,) or colors.ndim != 2 or colors.shape[1] < 3:
        return np.tile([GREY, GREY, GREY, 1.0], (n, 1))
    rgb = colors[:, :3] / 255.0
    return np.column_stack([rgb, colors[:, 3] / 255.0 if colors.shape[1] > 3 else np.ones(n)])
