"""At what size splats were fitted: it travels in their PLY, and says for which views they are too coarse."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from dreamcatalyst.data.camera import Cameras
from dreamcatalyst.data.images import Photo
from dreamcatalyst.data.lens import Lens
from dreamcatalyst.data.views import View
from dreamcatalyst.scene.fitted import Fitted
from dreamcatalyst.scene.gaussians import Gaussians
from dreamcatalyst.scene.ply import read_ply, write_ply


def view(width: int, height: int, focal: float, window: int | None = None) -> View:
    """Of `window` pixels of its photograph, drawn `width` wide."""
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    lens = Lens(focal, focal, 1, 1, 4000, 3000)
    photo = None if window is None else Photo(Path("a.jpg"), lens, (0, 0, window, window), width, height)
    return View("a", Cameras(torch.eye(4)[None], K[None], width, height), photo)


@pytest.fixture
def scene():
    n = torch.ones(5, 3)
    return Gaussians.from_colors(torch.rand(5, 3), 0.1 * n, 0.5 * n, torch.full((5,), 0.5))


def test_it_travels_in_the_header_and_splats_stay_as_they_are(tmp_path, scene):
    fitted = Fitted.at([view(256, 192, 210.25)])
    write_ply(tmp_path / "with.ply", scene, comments=["made by hand", fitted.comment])
    write_ply(tmp_path / "without.ply", scene)
    assert Fitted.of(tmp_path / "with.ply") == Fitted(256, 192, 210.2) and Fitted.of(tmp_path / "without.ply") is None
    for (name, one), (_, other) in zip(
        *(read_ply(tmp_path / n).parameters() for n in ("with.ply", "without.ply")), strict=True
    ):
        assert torch.equal(one, other), name


def test_a_fit_is_too_coarse_for_views_that_show_things_finer():
    """By focal length: a square crop of 512 pixels out of 4:3 needs a fit at 683 x 512."""
    crop = [view(512, 512, 560.0, window=3000)]  # of photographs of 4000 x 3000
    assert Fitted(256, 192, 210.0).too_coarse_for(crop) == pytest.approx(560 / 210)
    assert Fitted(512, 384, 420.0).too_coarse_for(crop) == pytest.approx(4 / 3)
    assert Fitted(683, 512, 559.0).too_coarse_for(crop) is None


def test_photographs_bound_what_a_fit_can_show():
    enlarged = [view(512, 512, 560.0, window=256)]  # of what is 256 pixels wide in the photograph
    assert Fitted(340, 256, 280.0).too_coarse_for(enlarged) is None
    assert Fitted(340, 256, 140.0).too_coarse_for(enlarged) == pytest.approx(2)
