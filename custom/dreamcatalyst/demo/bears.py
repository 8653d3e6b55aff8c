"""Bears of many builds and poses, as ellipsoids: what BEAR is one of."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from numpy.random import Generator
from torch import Tensor

from .shapes import turn
from .worlds import BEAR, Solid, solids

POSES = {"sitting": 0.8, "standing": 0.1, "walking": 0.1}  # and how often each is drawn
HEAD = ("head", "muzzle", "nose", "ear", "eye")
# The other poses: what replaces BEAR's rows of the trunk and limbs, and where the head's centre goes.
STANDING = (
    ("body", (0.0, 0.0, 0.56), (0.21, 0.23, 0.29)),
    ("belly", (0.08, 0.0, 0.52), (0.16, 0.18, 0.22)),
    ("arm", (0.10, 0.25, 0.60), (0.085, 0.08, 0.20)),
    ("arm", (0.10, -0.25, 0.60), (0.085, 0.08, 0.20)),
    ("leg", (0.03, 0.13, 0.18), (0.12, 0.11, 0.20)),
    ("leg", (0.03, -0.13, 0.18), (0.12, 0.11, 0.20)),
)
WALKING = (
    ("body", (-0.06, 0.0, 0.50), (0.21, 0.22, 0.38)),  # its own z axis is turned forward
    ("belly", (-0.06, 0.0, 0.45), (0.19, 0.20, 0.28)),
    ("arm", (0.20, 0.14, 0.24), (0.095, 0.085, 0.23)),
    ("arm", (0.20, -0.14, 0.24), (0.095, 0.085, 0.23)),
    ("leg", (-0.30, 0.14, 0.24), (0.115, 0.095, 0.23)),
    ("leg", (-0.30, -0.14, 0.24), (0.115, 0.095, 0.23)),
)
HEAD_CENTER = {"sitting": (0.08, 0.0, 0.88), "standing": (0.05, 0.0, 0.93), "walking": (0.36, 0.0, 0.66)}


def posed(pose: str) -> list[Solid]:
    """The bear in one of POSES, without pedestal, in the order of BEAR."""
    rest = {"standing": STANDING, "walking": WALKING}.get(pose)
    parts = [part for part in solids(BEAR) if part.name != "pedestal"]
    if rest is None:
        return parts
    move = torch.tensor(HEAD_CENTER[pose]) - torch.tensor(HEAD_CENTER["sitting"])
    head = [replace(part, center=part.center + move) for part in parts if part.name in HEAD]
    body = solids(rest)
    if pose == "walking":
        body = [replace(p, rotation=turn("y", 90)) if p.name in ("body", "belly") else p for p in body]
    return body[:2] + head + body[2:]


def turned(part: Solid, about: Float[Tensor, " 3"], rotation: Float[Tensor, "3 3"], scale: float = 1.0) -> Solid:
    """`part` turned and scaled about the point `about`."""
    center = about + scale * rotation @ (part.center - about)
    return replace(part, center=center, radii=part.radii * scale, rotation=rotation @ part.rotation)


def bear_solids(rng: Generator) -> list[Solid]:
    """A bear drawn from `rng`, without pedestal, its lowest point on z = 0: build, pose and proportions vary around
    BEAR's; facing +x."""
    pose = str(rng.choice(list(POSES), p=list(POSES.values())))
    draw = {name: float(rng.uniform(low, high)) for name, (low, high) in RANGES.items()}
    build = {
        "body": (draw["depth"], draw["girth"], draw["height"]),
        "belly": (draw["depth"] * draw["belly"], draw["girth"] * draw["belly"], draw["height"]),
        "muzzle": (draw["muzzle"], draw["snout"], draw["snout"]),
        "ear": (draw["ear"],) * 3,
        "eye": (draw["eye"],) * 3,
        "arm": (draw["limb"], draw["limb"], draw["reach"]),
        "leg": (draw["limb"], draw["limb"], draw["limb"]),
    }
    parts = [replace(p, radii=p.radii * torch.tensor(build.get(p.name, (1.0,) * 3))) for p in posed(pose)]
    head = next(p.center for p in parts if p.name == "head")
    look = turn("z", draw["look"]) @ turn("y", draw["nod"])
    out = []
    for part in parts:
        if part.name in ("muzzle", "nose"):  # a longer muzzle reaches further out
            part = replace(part, center=part.center + torch.tensor([0.10 * (draw["muzzle"] - 1), 0.0, 0.0]))
        if part.name in HEAD:
            part = turned(part, head, look, draw["head"])
        elif part.name == "arm" and pose != "walking":
            shoulder = part.center + torch.tensor([0.0, 0.0, float(part.radii[2])])
            side = 1.0 if part.center[1] > 0 else -1.0
            part = turned(part, shoulder, turn("x", side * draw["spread"]) @ turn("y", -draw["raise"]))
        elif part.name == "leg" and pose == "sitting":
            hip = part.center - torch.tensor([float(part.radii[0]), 0.0, 0.0])
            part = turned(part, hip, turn("z", (1.0 if part.center[1] > 0 else -1.0) * draw["splay"]))
        out.append(part)
    lowest = min(float(p.center[2] - ((p.rotation[2] * p.radii) ** 2).sum().sqrt()) for p in out)
    return [replace(p, center=p.center - torch.tensor([0.0, 0.0, lowest])) for p in out]


# What varies, as factors of BEAR's radii, and angles in degrees; BEAR itself lies inside.
RANGES = {
    "depth": (0.9, 1.12),
    "girth": (0.9, 1.15),
    "height": (0.94, 1.06),
    "belly": (0.9, 1.08),
    "head": (0.92, 1.15),
    "ear": (0.85, 1.2),
    "eye": (0.85, 1.2),
    "muzzle": (0.85, 1.3),
    "snout": (0.85, 1.15),
    "limb": (0.88, 1.15),
    "reach": (0.9, 1.15),
    "look": (-25.0, 25.0),
    "nod": (-12.0, 14.0),
    "spread": (-6.0, 22.0),
    "raise": (-8.0, 30.0),
    "splay": (-5.0, 20.0),
}
