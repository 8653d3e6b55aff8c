"""Splats of points and meshes, against distances and surfaces known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from dreamcatalyst.errors import SceneError
from dreamcatalyst.scene.create import from_mesh, from_points
from dreamcatalyst.scene.gaussians import SH_C0, Gaussians


def colors(scene: Gaussians) -> torch.Tensor:
    return 0.5 + SH_C0 * scene.sh0[:, 0]


def test_a_grid_gets_its_spacing_and_its_colours():
    axis = torch.arange(4.0) * 0.25
    xyz = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    rgb = torch.rand(64, 3, generator=torch.Generator().manual_seed(0))
    scene = from_points(xyz, rgb)
    torch.testing.assert_close(scene.scales, torch.full((64, 3), 0.25))
    torch.testing.assert_close(colors(scene), rgb)
    torch.testing.assert_close(scene.opacities, torch.full((64,), 0.1))
    assert scene.sh_degree == 3 and not scene.shN.any()
    assert scene.quats.tolist() == [[1, 0, 0, 0]] * 64


def test_the_scale_is_the_root_mean_square_of_three_distances():
    xyz = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 2], [9, 9, 9]])
    assert from_points(xyz, torch.zeros(5, 3)).scales[0, 0].item() == pytest.approx(((1 + 4 + 4) / 3) ** 0.5)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_points(n):
    scene = from_points(torch.arange(3.0 * n).reshape(n, 3), torch.zeros(n, 3), sh_degree=0)
    assert len(scene) == n and scene.log_scales.isfinite().all()


def test_points_that_coincide_keep_a_finite_scale():
    xyz = torch.cat([torch.zeros(6, 3), torch.eye(3)])
    assert from_points(xyz, torch.zeros(9, 3)).log_scales.isfinite().all()
    assert from_points(torch.zeros(6, 3), torch.zeros(6, 3)).log_scales.isfinite().all()


@pytest.mark.usefixtures("unchecked")
def test_points_that_cannot_be_used():
    with pytest.raises(SceneError, match="empty"):
        from_points(torch.zeros(0, 3), torch.zeros(0, 3))
    with pytest.raises(SceneError, match=r"must both be \[P,3\]"):
        from_points(torch.zeros(4, 3), torch.zeros(3, 3))
    with pytest.raises(SceneError, match="1 of 4 are NaN"):
        from_points(torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, torch.nan, 0], [3, 0, 0]]), torch.zeros(4, 3))


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb", "stl", "off"])
def test_surfaces_are_covered_evenly(tmp_path, suffix):
    box = trimesh.creation.box(extents=(2, 1, 1))
    box.export(tmp_path / f"box.{suffix}")
    xyz = from_mesh(tmp_path / f"box.{suffix}", 4000, seed=1).means
    half = torch.tensor([1, 0.5, 0.5])
    assert xyz.abs().le(half + 1e-5).all()
    on_side = (xyz.abs() - half).abs() < 1e-5
    assert on_side.any(dim=1).all()
    assert on_side[:, 0].float().mean().item() == pytest.approx(2 / 10, abs=0.03)  # two of 1x1 of an area of 10


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_vertex_colours_are_interpolated(tmp_path, suffix):
    square = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    square.visual.vertex_colors = (np.c_[square.vertices, np.ones(4)] * 255).astype(np.uint8)
    square.export(tmp_path / f"a.{suffix}")
    scene = from_mesh(tmp_path / f"a.{suffix}", 200)
    torch.testing.assert_close(colors(scene)[:, :2], scene.means[:, :2], atol=1e-4, rtol=0)


def test_textures_are_looked_up(tmp_path):
    from PIL import Image

    picture = Image.fromarray(
        np.repeat([[[255, 0, 0], [0, 0, 255]]], 2, axis=0).astype(np.uint8).repeat(8, 0).repeat(8, 1)
    )
    uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
    square = trimesh.Trimesh([[*p, 0] for p in uv], [[0, 1, 2], [0, 2, 3]], process=False)
    square.visual = trimesh.visual.TextureVisuals(uv=uv, image=picture)
    square.export(tmp_path / "a.glb")
    scene = from_mesh(tmp_path / "a.glb", 300)
    left, right = scene.means[:, 0] < 0.45, scene.means[:, 0] > 0.55
    torch.testing.assert_close(colors(scene)[left], torch.tensor([[1.0, 0, 0]]).expand(int(left.sum()), 3))
    torch.testing.assert_close(colors(scene)[right], torch.tensor([[0, 0, 1.0]]).expand(int(right.sum()), 3))


def test_point_clouds_whole_or_sampled(tmp_path):
    xyz = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    rgba = np.random.default_rng(1).integers(0, 255, (50, 4), dtype=np.uint8)
    trimesh.PointCloud(xyz, colors=rgba).export(tmp_path / "a.ply")
    scene = from_mesh(tmp_path / "a.ply", 100)
    torch.testing.assert_close(scene.means, torch.from_numpy(xyz))
    torch.testing.assert_close(colors(scene), torch.from_numpy(rgba[:, :3]) / 255)
    few = from_mesh(tmp_path / "a.ply", 10, seed=3)
    assert len(few) == 10 and torch.equal(few.means, from_mesh(tmp_path / "a.ply", 10, seed=3).means)


def test_parts_of_a_scene_stand_where_they_were_placed(tmp_path):
    scene = trimesh.Scene()
    for x in (-5, 5):
        scene.add_geometry(
            trimesh.creation.icosphere(radius=1), transform=trimesh.transformations.translation_matrix([x, 0, 0])
        )
    scene.export(tmp_path / "a.glb")
    means = from_mesh(tmp_path / "a.glb", 500).means
    assert ((means[:, 0].abs() - 5).abs() < 1.01).all()
    assert (means[:, 0] > 0).float().mean().item() == pytest.approx(0.5, abs=0.1)


def test_files_that_cannot_be_used(tmp_path):
    with pytest.raises(SceneError, match="no such file"):
        from_mesh(tmp_path / "a.obj", 10)
    path = tmp_path / "a.obj"
    path.write_text("nothing")
    with pytest.raises(SceneError, match="no faces and no points|cannot read it"):
        from_mesh(path, 10)
    (tmp_path / "a.xyzzy").write_text("nothing")
    with pytest.raises(SceneError, match="trimesh cannot read it"):
        from_mesh(tmp_path / "a.xyzzy", 10)
    path.write_text("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n")
    with pytest.raises(SceneError, match="no area"):
        from_mesh(path, 10)
    with pytest.raises(SceneError, match="asked for 0 splats"):
        from_mesh(path, 0)
