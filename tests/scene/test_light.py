"""How a scene is lit, found from colours and normals alone, against lights that are known."""

import pytest
import torch
from dreamcatalyst.scene.gaussians import SH_C0, Gaussians
from dreamcatalyst.scene.harmonics import basis
from dreamcatalyst.scene.light import DAYLIGHT, brightness, lamp, normals, plain_colors, relit
from dreamcatalyst.scene.place import frames


def spheres(count: int, growth: torch.Tensor, seed: int = 0) -> tuple[Gaussians, torch.Tensor]:
    """Balls far apart, each of one colour, whose logarithm grows linearly with the normal by `growth` [3,3]."""
    g = torch.Generator().manual_seed(seed)
    made, facing = [], []
    for k in range(count):
        out = torch.nn.functional.normalize(torch.randn(400, 3, generator=g), dim=1)
        colour = (0.25 + 0.25 * torch.rand(3, generator=g)) * (out @ growth).exp()
        place = torch.tensor([10.0 * k, 0, 0])
        scales = torch.tensor([0.1, 0.1, 0.01]).repeat(400, 1)
        made.append(Gaussians.from_colors(place + out, scales, colour, torch.full((400,), 0.9), frames(out)))
        facing.append(out)
    return Gaussians.cat(made), torch.cat(facing)


GROWTH = torch.tensor([[0.3, 0.2, 0.1], [0.0, 0.0, 0.0], [0.25, 0.3, 0.35]])


def test_normals_face_those_who_see_them():
    scene, facing = spheres(2, torch.zeros(3, 3))
    flipped = torch.where(torch.arange(len(scene))[:, None] % 2 == 0, facing, -facing)
    near = flipped + 0.3 * torch.randn(facing.shape, generator=torch.Generator().manual_seed(1))
    agree = (near * flipped).sum(1, keepdim=True) > 0
    torch.testing.assert_close(normals(scene, near), torch.where(agree, flipped, -flipped), atol=1e-5, rtol=0)


def test_a_lamp_is_found_whatever_is_painted():
    scene, facing = spheres(4, GROWTH)
    torch.testing.assert_close(
        lamp(scene, facing, torch.ones(len(scene))), GROWTH, atol=0.045, rtol=0
    )  # the ridge takes a twentieth
    even, facing = spheres(4, torch.zeros(3, 3))
    assert lamp(even, facing, torch.ones(len(even))).abs().max() < 1e-3


def test_where_all_face_one_way_no_lamp_is_made_up():
    """A floor with a lawn and a path says nothing of how light depends on the normal."""
    g = torch.Generator().manual_seed(0)
    means = torch.cat([torch.rand(500, 2, generator=g), torch.zeros(500, 1)], dim=1)
    colours = torch.where(means[:, :1] > 0.5, torch.tensor([0.3, 0.5, 0.2]), torch.tensor([0.7, 0.6, 0.5]))
    floor = Gaussians.from_colors(means, torch.full((500, 3), 0.1), colours, torch.full((500,), 0.9))
    assert lamp(floor, torch.tensor([0.0, 0, 1]).expand(500, 3), torch.ones(500)).abs().max() < 1e-6


def test_daylight_is_left_alone_and_dusk_is_found():
    day = DAYLIGHT * torch.ones(100, 3)
    torch.testing.assert_close(brightness(day), torch.ones(3))
    torch.testing.assert_close(brightness(1.1 * day), torch.ones(3))  # within what pictures in daylight differ by
    torch.testing.assert_close(brightness(1.6 * day), torch.ones(3))  # snow is white, no stronger light
    blue = torch.tensor([0.3, 0.4, 0.6])
    torch.testing.assert_close(brightness(blue * day), blue, atol=0.03, rtol=0)
    assert bool(brightness(torch.zeros(10, 3)).isfinite().all())


@pytest.mark.parametrize("degree", [0, 3])
def test_colours_change_from_every_side_alike(degree):
    g = torch.Generator().manual_seed(0)
    scene = spheres(1, GROWTH)[0]
    shN = 0.1 * torch.randn(400, (degree + 1) ** 2 - 1, 3, generator=g)
    scene = Gaussians(scene.means, scene.quats, scene.log_scales, scene.logit_opacities, scene.sh0, shN)
    factors = 0.5 + torch.rand(400, 3, generator=g)
    y = basis(torch.nn.functional.normalize(torch.randn(7, 3, generator=g), dim=1), degree)
    before, after = (0.5 + torch.einsum("dk,nkc->dnc", y, s.sh) for s in (scene, relit(scene, factors)))
    torch.testing.assert_close(after, factors * before, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(plain_colors(scene), 0.5 + SH_C0 * scene.sh0[:, 0])
