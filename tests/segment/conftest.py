"""A green disc before a grey wall, seen by a few cameras: what every segmenter is asked to find."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from dreamcatalyst.data.camera import Cameras, look_at
from dreamcatalyst.demo.shapes import disc, surface
from dreamcatalyst.guidance.config import GuidanceConfig
from dreamcatalyst.guidance.guidance import Guidance
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.scene.gaussians import Gaussians
from dreamcatalyst.segment.api import MaskRequest

from tests.segment.small_models import SIDE, make_clipseg

GREEN, GREY = (0.15, 0.60, 0.15), (0.45, 0.45, 0.48)
RADIUS, HEIGHT = 0.6, 1.0  # of the disc, over a wall of radius 2
PROMPT = "Make it autumn"  # which acts on greens, and hardly on greys


@dataclass(frozen=True)
class DiscWorld:
    """request; truth [N] bool: the splats of the disc; views [V,H,W]: the disc as it is seen."""

    request: MaskRequest
    truth: torch.Tensor
    views: torch.Tensor


def part(center: tuple[float, float, float], radius: float, n: int, color: tuple[float, float, float]) -> Gaussians:
    points, normals, widths = disc(center, radius, n)
    return surface(points, normals, widths, torch.tensor(color).expand(n, 3))


@pytest.fixture(scope="session")
def disc_world() -> DiscWorld:
    scene = Gaussians.cat([part((0.0, 0, HEIGHT), RADIUS, 150, GREEN), part((0.0, 0, 0), 2.0, 500, GREY)])
    angles = torch.arange(5) * 1.2566
    eyes = torch.stack([3 * angles.cos(), 3 * angles.sin(), torch.full((5,), 3.5)], dim=-1)
    viewmats = look_at(eyes, torch.tensor([0.0, 0, 0.5]), torch.tensor([0.0, 0, 1]))
    K = torch.tensor([[64.0, 0, 28], [0, 64.0, 24], [0, 0, 1]])
    cameras = Cameras(viewmats, K.repeat(5, 1, 1), 56, 48)
    truth = torch.arange(len(scene)) < 150
    drawn = rasterize(scene, cameras, features=truth.float()[:, None])
    guidance = Guidance(GuidanceConfig(), PROMPT)
    request = MaskRequest(
        scene=scene.with_extra(mask=truth.float()),
        cameras=[cameras[i] for i in range(5)],
        names=[f"photos/{i:04d}.jpg" for i in range(5)],
        views=[0, 1, 2, 4],
        extent=1.3,
        render=lambda index: drawn.rgb[index],
        guidance=guidance,
        prompt=PROMPT,
    )
    return DiscWorld(request, truth, drawn.features[..., 0])


def learn_green_discs(model, processor) -> None:
    """Teach a small CLIPSeg what a green disc is, on random pictures of one before a wall."""
    generator = torch.Generator().manual_seed(1)
    words = processor(text=["green disc"], return_tensors="pt")
    y, x = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij")
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    for _ in range(60):
        place = torch.rand(8, 3, 1, 1, generator=generator)
        center, radius = SIDE * (0.2 + 0.6 * place[:, :2]), SIDE * (0.1 + 0.2 * place[:, 2])
        target = ((x - center[:, 0]) ** 2 + (y - center[:, 1]) ** 2 < radius**2).float()
        image = torch.where(target[:, None] > 0, torch.tensor(GREEN)[:, None, None], torch.tensor(GREY)[:, None, None])
        image = image * (0.8 + 0.4 * torch.rand(8, 1, 1, 1, generator=generator))
        text = {name: value.expand(8, -1) for name, value in words.items()}
        logits = model(pixel_values=(image - 0.5) / 0.5, **text).logits
        loss = torch.nn.functional.binary_cross_entropy_with_logits(logits, target)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


@pytest.fixture(scope="session")
def clipseg(tmp_path_factory):
    return make_clipseg(tmp_path_factory.mktemp("models") / "clipseg", learn_green_discs)
