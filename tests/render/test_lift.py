"""Masks brought back to splats: sums of alpha T, against the dense twin and against what the published count gets."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.data.camera import Cameras
from dreamcatalyst.errors import SceneError
from dreamcatalyst.render.api import BACKENDS
from dreamcatalyst.render.lift import lift, vote
from dreamcatalyst.render.projection import project, radii
from dreamcatalyst.render.reference import blend
from dreamcatalyst.scene.gaussians import Gaussians

CPU_BACKENDS = [name for name in BACKENDS.names() if name != "gsplat"]


def dense_weights(scene: Gaussians, camera: Cameras) -> torch.Tensor:
    """alpha T [H*W,N] of one view by definition, in float64."""
    scene, camera = scene.to(dtype=torch.float64), camera.to(dtype=torch.float64)
    splats = project(scene.means, scene.quats, scene.scales, camera)
    order = splats.depths[0].argsort(stable=True)
    order = order[radii(splats, scene.opacities[None], camera)[0, order] > 0]
    drawn = splats.means2d[0, order], splats.covs2d[0, order], splats.dets[0, order], scene.opacities[order]
    weights = torch.zeros(camera.height * camera.width, len(scene), dtype=torch.float64)
    weights[:, order] = blend(*drawn, camera)
    return weights


def masks_for(cameras: Cameras) -> torch.Tensor:
    return torch.rand(len(cameras), cameras.height, cameras.width, generator=torch.Generator().manual_seed(5))


@pytest.mark.parametrize("backend", CPU_BACKENDS)
def test_the_sums_are_those_of_alpha_t(backend, random_scene, pinhole):
    scene, cameras = random_scene(40, sh_degree=1), pinhole(29, 21, views=3)
    masks = masks_for(cameras)
    found = lift(scene, cameras, masks, backend=backend)
    weights = [dense_weights(scene, cameras[v]) for v in range(3)]
    inside = sum(w.T @ m.flatten().double() for w, m in zip(weights, masks, strict=True))
    total = sum(w.sum(dim=0) for w in weights)
    # A pixel whose alpha lies at the threshold 1/255 may be counted by one and not by the other.
    torch.testing.assert_close(found.inside.double(), inside, rtol=2e-3, atol=1e-2)
    torch.testing.assert_close(found.total.double(), total, rtol=2e-3, atol=1e-2)


def test_float64_is_exact_and_views_add_up(random_scene, pinhole):
    scene, cameras = random_scene(20, sh_degree=0).to(dtype=torch.float64), pinhole(17, 13, views=2)
    masks = masks_for(cameras).double()
    both = lift(scene, cameras, masks)
    apart = lift(scene, cameras[0], masks[:1]) + lift(scene, cameras[1], masks[1:])
    weights = sum(dense_weights(scene, cameras[v]).T @ masks[v].flatten() for v in range(2))
    torch.testing.assert_close(both.inside, weights, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(apart.inside, both.inside, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(apart.total, both.total, rtol=1e-12, atol=1e-12)


def test_all_that_is_seen_is_the_images_alpha(random_scene, pinhole):
    from dreamcatalyst.render.api import rasterize

    scene, cameras = random_scene(60), pinhole(32, 24)
    found = lift(scene, cameras, torch.ones(1, 24, 32))
    assert torch.equal(found.inside, found.total)
    assert float(found.total.sum()) == pytest.approx(float(rasterize(scene, cameras).alpha.sum()), rel=1e-4)


def test_nothing_else_is_differentiated(random_scene, pinhole):
    scene = random_scene(10)
    scene.means.requires_grad_()
    with torch.no_grad():  # as in validation
        found = lift(scene, pinhole(16, 16), torch.ones(1, 16, 16))
    assert not found.inside.requires_grad and scene.means.grad is None and float(found.total.sum()) > 0


def test_the_count_is_of_the_pixels_that_a_splat_contributes_to(random_scene, pinhole):
    scene, cameras = random_scene(40, sh_degree=0), pinhole(29, 21, views=2)
    masks = (masks_for(cameras) > 0.5).float()
    found = vote(scene, cameras, masks)
    seen = [(dense_weights(scene, cameras[v]) > 0).double() for v in range(2)]
    total = sum(s.sum(dim=0) for s in seen)
    inside = sum(s.T @ m.flatten().double() for s, m in zip(seen, masks, strict=True))
    # Whole pixels; those at the threshold of alpha, a percent or so, may fall either way in float32.
    assert torch.equal(found.total, found.total.round())
    assert float((found.total.double() - total).abs().max()) <= 2
    assert float((found.inside.double() - inside).abs().max()) <= 2


@pytest.mark.parametrize("shape", [(1, 16, 16), (2, 16, 17)])
def test_masks_of_another_size_are_refused(shape, random_scene, pinhole):
    with pytest.raises(SceneError, match=r"masks: got . of shapes .* expected 2 of shape \(16, 16\)"):
        lift(random_scene(3), pinhole(16, 16, views=2), torch.zeros(shape))
