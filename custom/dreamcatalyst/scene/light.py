"""How a scene is lit, found from its colours alone, and a thing's colours brought into that light.

Two parts. By which direction a surface faces: colours of one place differ with their normals, and what is the same in
all places is the light (as irradiance, a smooth function of the normal: Ramamoorthi and Hanrahan 2001). And the colour
and brightness of all of it, as the brightest of the pictures have it (shades of grey, Finlayson and Trezzi 2004).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .gaussians import SH_C0, Gaussians

PLACES = 12  # parts of a scene within which surfaces are taken to be of one material each
RIDGE = 0.01  # what holds the light to be even where normals say little, in variance of normals
HALF = 0.5  # pixels in which a splat must be seen
ROUNDS = 3  # of reweighting
DARKEST = 0.02  # colours below count as this: their logarithm says nothing
MOST = 20_000  # splats that are looked at
NORM = 6.0  # Finlayson and Trezzi's
DAYLIGHT = 0.6  # that norm in good light: 0.59 of 24 synthetic scenes (seeds 1000 to 1023), 0.67 of photographs
DOUBT = 0.15  # standard deviation of its logarithm among those worlds
STRONGEST = 4.0  # factor by which light may change a colour, either way


def normals(scene: Gaussians, towards: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
    """Unit normals of splats, their thinnest axes, each on the side of its direction in `towards` [N,3]: there are
    those who see it."""
    w, x, y, z = torch.nn.functional.normalize(scene.quats.detach(), dim=-1).unbind(-1)
    axes = torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], dim=-1),
            torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=-1),
            torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=-1),
        ],
        dim=1,
    )  # rows: where each axis points
    thinnest = scene.log_scales.detach().argmin(dim=1)
    found = axes[torch.arange(len(scene), device=thinnest.device), thinnest]
    return torch.where((found * towards).sum(dim=1, keepdim=True) < 0, -found, found)


def plain_colors(scene: Gaussians) -> Float[Tensor, "N 3"]:
    """Colours without what depends on the view."""
    return 0.5 + SH_C0 * scene.sh0[:, 0].detach()


def lamp(scene: Gaussians, facing: Float[Tensor, "N 3"], seen: Float[Tensor, " N"]) -> Float[Tensor, "3 3"]:
    """How the logarithm of RGB (columns) grows with the normal's x, y, z (rows), by what is the same in all places.
    seen [N]: in how many pixels each is; of those that nobody sees the colours are what nothing has judged.

    Colours are log albedo + log light(normal). Within a place the albedo is taken to be one, so that differences from
    the place's mean are the light's: weighted least squares, held to zero by RIDGE, and with less weight for what does
    not agree (Cauchy's). Even light and normals that are all alike give zeros.
    """
    from scipy.cluster.vq import kmeans2

    shown = (seen > HALF).nonzero()[:, 0]
    shown = shown[:: max(1, -(-len(shown) // MOST))]
    if len(shown) < 2:
        return scene.means.new_zeros(3, 3)
    scene, facing = scene[shown], facing[shown].double()
    logs = plain_colors(scene).double().clamp_min(DARKEST).log()
    places = min(PLACES, len(scene))
    spots = scene.means.detach().cpu().double().numpy()
    _, place = kmeans2(spots, far_apart(spots, places), minit="matrix")
    member = torch.nn.functional.one_hot(torch.from_numpy(place).long(), places).to(facing)
    weights, solution = torch.ones_like(facing[:, 0]), facing.new_zeros(3, 3)

    def apart(values: Tensor) -> Tensor:
        sums = member.T @ (weights[:, None] * values)
        return values - member @ (sums / (member.T @ weights).clamp_min(1e-9)[:, None])

    for _ in range(ROUNDS):
        turned, varied = apart(facing), apart(logs)
        share = weights[:, None] / weights.sum()
        matrix = (share * turned).T @ turned + RIDGE * torch.eye(3).to(facing)
        solution = torch.linalg.solve(matrix, (share * turned).T @ varied)
        misses = (varied - turned @ solution).norm(dim=1)
        weights = 1 / (1 + (misses / (1.48 * misses.median() + 1e-4)) ** 2)
    return solution.to(scene.means)


def far_apart(spots: Float[np.ndarray, "N 3"], count: int) -> Float[np.ndarray, "K 3"]:
    """`count` of the spots, each as far as can be from those before it; the first is the one nearest to the middle."""
    found = [int(np.linalg.norm(spots - spots.mean(axis=0), axis=1).argmin())]
    away = np.full(len(spots), np.inf)
    while len(found) < count:
        away = np.minimum(away, np.linalg.norm(spots - spots[found[-1]], axis=1))
        found.append(int(away.argmax()))
    return spots[found]


def brightness(pictures: Float[Tensor, "P 3"]) -> Float[Tensor, " 3"]:
    """The factor by which a scene's light differs from good daylight, RGB in (0,1]: pixels [P,3] in [0,1] of its
    pictures, as their Minkowski norm says. 1 where the difference is within what pictures in daylight differ by (the
    estimate is shrunk as James and Stein do), and never more: what is brighter than daylight is white, not light."""
    norm = pictures.double().clamp(0, 1).pow(NORM).mean(dim=0).pow(1 / NORM)
    apart = (norm.clamp_min(DARKEST) / DAYLIGHT).log()
    kept = max(0.0, 1 - 3 * DOUBT**2 / max(float(apart.square().sum()), 1e-12))
    gain = (kept * apart).exp()
    return (gain / gain.max().clamp_min(1.0)).to(pictures)


def relit(scene: Gaussians, factors: Float[Tensor, "N 3"]) -> Gaussians:
    """The same splats with their colours, from every side, times RGB factors [N,3]."""
    factors = factors.clamp(1 / STRONGEST, STRONGEST)[:, None].to(scene.sh0)
    return replace(scene, sh0=factors * scene.sh0 + (factors - 1) * (0.5 / SH_C0), shN=factors * scene.shN)
