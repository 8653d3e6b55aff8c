"""Splats of points and meshes, against distances and surfaces known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from dreamcatalyst.demo.shapes import facing
from dreamcatalyst.errors import SceneError
from dreamcatalyst.scene.create import flat_splats, from_mesh, from_points
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


def checker(tmp_path, name="box.glb"):
    """A box with a checker texture of 4 x 4 fields on each side."""
    from PIL import Image

    fields = np.indices((4, 4)).sum(axis=0) % 2
    picture = np.where(fields[..., None] == 0, [230, 40, 30], [30, 60, 220]).repeat(16, 0).repeat(16, 1)
    box = trimesh.creation.box(extents=(2, 1, 1))
    corners = box.vertices[box.faces].reshape(-1, 3)  # each face its own, so that each side has its own picture
    normals = np.repeat(box.face_normals, 3, axis=0)
    axis = np.abs(normals).argmax(axis=1)
    flat = np.array([np.delete(c / box.extents + 0.5, a) for c, a in zip(corners, axis, strict=True)])
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    mesh.visual = trimesh.visual.TextureVisuals(uv=flat, image=Image.fromarray(picture.astype(np.uint8)))
    mesh.export(tmp_path / name)
    return tmp_path / name


@pytest.mark.parametrize("name", ["box.glb", "box.obj"])
def test_a_textured_box_becomes_flat_splats_of_its_colours(tmp_path, name):
    scene, surface = flat_splats(checker(tmp_path, name), 6000)
    assert surface and len(scene) == pytest.approx(6000, abs=12)
    half = torch.tensor([1, 0.5, 0.5])
    assert (((scene.means.abs() - half).abs() < 1e-5).sum(dim=1) >= 1).all()  # on the surface
    side = (scene.means.abs() / half).argmax(dim=1)
    axis = scene.log_scales.argmin(dim=1)
    assert (axis == 2).all()  # flat along their own z
    normal = facing(scene)
    assert (normal[torch.arange(len(scene)), side].abs() > 0.999).all()
    assert ((normal * scene.means).sum(dim=1) > 0).all()  # outwards
    flat = scene.means / (2 * half) + 0.5
    where = torch.stack([flat[k][torch.arange(3) != side[k]] for k in range(len(flat))])
    inner = ((where * 4) % 1 - 0.5).abs().amax(dim=1) < 0.4  # not at the edge of a field
    down = (where[:, 0] * 4).floor() + ((1 - where[:, 1]) * 4).floor()
    wanted = torch.where((down % 2 == 0)[:, None], torch.tensor([230.0, 40, 30]), torch.tensor([30.0, 60, 220])) / 255
    torch.testing.assert_close(colors(scene)[inner], wanted[inner], atol=0.03, rtol=0)


def test_flat_splats_close_their_surface(tmp_path):
    """No ray from outside sees through a box; each splat is about as wide as its neighbours are far."""
    from dreamcatalyst.data.camera import Cameras, look_at
    from dreamcatalyst.render.api import rasterize

    scene, _ = flat_splats(checker(tmp_path), 3000)
    eye = torch.tensor([[3.0, 2.0, 1.5], [-3.0, 0.5, 2.0]])
    K = torch.tensor([[60.0, 0, 20], [0, 60, 20], [0, 0, 1]]).repeat(2, 1, 1)
    cameras = Cameras(look_at(eye, torch.zeros(3), torch.tensor([0.0, 0, 1])), K, 40, 40)
    alpha = rasterize(scene, cameras).alpha[:, 16:24, 16:24]
    assert float(alpha.min()) > 0.9


def test_materials_without_a_texture_have_their_colour_and_alpha(tmp_path):
    box = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[200, 100, 50, 128], alphaMode="BLEND")
    box.visual = trimesh.visual.TextureVisuals(material=material)
    box.export(tmp_path / "a.glb")
    scene, _ = flat_splats(tmp_path / "a.glb", 300)
    torch.testing.assert_close(
        colors(scene), torch.tensor([200.0, 100, 50]).expand(len(scene), 3) / 255, atol=0.01, rtol=0
    )
    torch.testing.assert_close(scene.opacities, torch.full((len(scene),), 0.95 * 128 / 255), atol=0.01, rtol=0)


def test_a_point_cloud_becomes_splats_that_touch(tmp_path):
    grid = np.stack(np.meshgrid(*[np.arange(6.0)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    rgba = np.random.default_rng(1).integers(0, 255, (len(grid), 4), dtype=np.uint8)
    rgba[:, 3] = 255
    rgba[0, 3] = 0
    trimesh.PointCloud(grid, colors=rgba).export(tmp_path / "a.ply")
    scene, surface = flat_splats(tmp_path / "a.ply", 1000)
    assert not surface and len(scene) == len(grid) - 1  # a clear one is left out
    torch.testing.assert_close(colors(scene), torch.from_numpy(rgba[1:, :3]) / 255)
    assert 0.5 < float(scene.scales.median()) < 0.8


def test_meshes_that_are_nothing(tmp_path):
    (tmp_path / "nan.obj").write_text("v 0 0 0\nv 1 0 0\nv nan 1 0\nf 1 2 3\n")
    with pytest.raises(SceneError, match="NaN or infinite|no faces"):
        flat_splats(tmp_path / "nan.obj", 10)
    trimesh.PointCloud(np.array([[0, 0, 0], [1, np.nan, 0]])).export(tmp_path / "nan.ply")
    with pytest.raises(SceneError, match="1 of 2 points are NaN"):
        flat_splats(tmp_path / "nan.ply", 10)
    box = trimesh.creation.box()
    box.visual.vertex_colors = np.tile([255, 255, 255, 0], (8, 1)).astype(np.uint8)
    box.export(tmp_path / "clear.ply")
    with pytest.raises(SceneError, match="clear"):
        flat_splats(tmp_path / "clear.ply", 10)
