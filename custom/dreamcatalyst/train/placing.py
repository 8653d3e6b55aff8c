"""A thing that is put into a scene: read, placed, and lit as the scene is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from .. import plugin
from ..data.camera import Cameras, look_at
from ..data.formats import AXES
from ..data.orbit import world_up
from ..data.origin import Origin
from ..data.truth import GroundTruth
from ..data.views import Capture, view_number
from ..demo.capture import PREFIX
from ..demo.shapes import sphere_points
from ..demo.things import first_thing, relit
from ..demo.worlds import World, make_world
from ..errors import ConfigError, SceneError, nearest
from ..render.ground import ground_at, level_under, require_level
from ..render.lift import lift
from ..scene import light
from ..scene.create import flat_splats
from ..scene.formats.api import named, read_splats, splat_origin
from ..scene.formats.gltf import KHR
from ..scene.formats.gltffile import GltfFile
from ..scene.gaussians import Gaussians
from ..scene.place import ADDED, Similarity, Stance, joined, moved, rotation_from, stance, turn_between
from ..scene.plyfile import read_vertices
from .add_config import AddConfig
from .drawing import Drawer

LOOKED_AT = 8  # views whose colours say how bright the scene's light is
VIEWPOINTS = 24  # views that say which side of a splat is out: of the scene, and around a thing
SIDE = 96  # pixels of those around a thing
UNSEEN = 1e-6  # pixels with which a view counts that does not see a splat: where none does, they decide
FLAT = 1e-3  # of its radius: a thing that is lower has no height to go by
LARGE = 20.0  # times the scene's extent, or less than a part of it, from which on a thing's size is surely a mistake


@dataclass(frozen=True)
class Thing:
    """What is put in, in its own coordinates. scene: its splats; axis: which of its axes stands up; surface: whether
    its splats lie on one, so that they have normals; lit: whether light is in its colours; world: it was made in."""

    scene: Gaussians
    axis: str
    surface: bool = True
    lit: bool = True
    world: World | None = None


@dataclass(frozen=True)
class Added:
    """A scene with a thing in it. scene: the splats that were there, and then `count` of the thing. foot: where it
    stands, world units of the run; height: how high it is; gain: by which its colours were multiplied, RGB, on average;
    truth: the same lit as it would be, where that is known."""

    scene: Gaussians
    count: int
    foot: list[float]
    height: float
    gain: list[float]
    truth: GroundTruth | None

    @property
    def rows(self) -> Tensor:
        """Which splats are the thing's, bool [N]."""
        return self.scene.extra[ADDED] > 0.5


def read_thing(config: AddConfig, orbit_up: str, seed: int, drop_nonfinite: bool, origin: Origin | None) -> Thing:
    """The thing that a config names. origin: of the scene, where the thing keeps its own coordinates; else those near
    its own. Raises ConfigError and SceneError."""
    axis = config.axis(False, orbit_up)
    if config.made:
        world = make_world(config.path.removeprefix(PREFIX), "system.add.path")
        return Thing(first_thing(world), axis, world=world)
    path = Path(config.path).expanduser()
    if is_splats(path):
        zero = splat_origin(path) if origin is None else origin
        scene = read_splats(path, drop_nonfinite=drop_nonfinite, origin=zero)
        return Thing(scene, config.axis(True, orbit_up))
    scene, surface = flat_splats(path, config.splats, seed)
    if origin is not None:
        scene = moved(scene, Similarity(torch.eye(3).double(), 1.0, -torch.tensor(origin).double()))
    return Thing(scene, axis, surface, lit=False)


def is_splats(path: Path) -> bool:
    """Whether a file holds splats, and no mesh and no plain points: PLY and glTF may hold any of them. Raises
    ConfigError where there is no such file, and SceneError where it cannot be read."""
    if path.is_dir():  # of a SOG's parts, or an error's
        return True
    if not path.is_file():
        beside = [other.name for other in path.parent.glob("*")] if path.parent.is_dir() else []
        raise ConfigError(f"system.add.path: no such file: '{path}'.{nearest(path.name, beside)}")
    suffix = path.suffix.lower()
    if suffix == ".ply":
        columns = read_vertices(path).columns
        return "opacity" in columns or "packed_position" in columns
    if suffix in (".glb", ".gltf"):
        return KHR in GltfFile(path).tree.get("extensionsUsed", [])
    return named(path) is not None


class Adder:
    """Puts a thing into scenes of one capture. draw: renders; scene: the splats that are there."""

    def __init__(self, config: AddConfig, thing: Thing, capture: Capture, draw: Drawer, origin: Origin):
        self.config, self.thing, self.capture, self.draw, self.origin = config, thing, capture, draw, origin

    @cached_property
    def up(self) -> Tensor:
        """What is up in the scene, [3] float64."""
        return world_up(self.capture.training_cameras)

    @torch.no_grad()
    def __call__(self, scene: Gaussians, host: World | None) -> Added:
        """`scene` with the thing in it. host: the synthetic scene that the scene is, if it is one."""
        there = moved(self.thing.scene.to(scene.means.device), self.place(scene))
        self.warn_of_size(there)
        factors = self.light(scene, there)
        lit = light.relit(there, factors)
        stands = stance(there, self.up)
        whole, truth = joined(scene, lit), None
        if host is not None and self.thing.world is not None and self.thing.scene.sh_degree == 0:
            ideal = relit(self.thing.scene, self.thing.world.light, there.to("cpu"), host.light)
            truth = GroundTruth(joined(scene, ideal.to(scene.means.device)), whole.extra[ADDED][:, None])
        return Added(whole, len(lit), stands.foot.tolist(), stands.height, factors.mean(dim=0).tolist(), truth)

    # --- where

    def place(self, scene: Gaussians) -> Similarity:
        """From the thing's own coordinates to the scene's."""
        config, turn = self.config, rotation_from(self.config.rotation)
        if config.stands:
            turn = turn @ turn_between(signed_axis(self.thing.axis), self.up)
        upright = moved(self.thing.scene, Similarity(turn, 1.0, torch.zeros(3).double()))
        stands = stance(upright, self.up)
        scale = self.scale(stands)
        if not config.stands:
            return Similarity(turn, scale, torch.zeros(3).double())
        foot = self.foot(scene, scale * stands.radius, scale * stands.height)
        return Similarity(turn, scale, foot.cpu() - scale * stands.foot.cpu())

    def scale(self, stands: Stance) -> float:
        """How many times as large the thing becomes. stands: how it does, as large as it is."""
        config = self.config
        wanted = config.height if config.size is None else config.size * self.capture.extent
        if wanted is None:
            return 1.0 if config.scale is None else config.scale
        if not stands.height > FLAT * stands.radius:
            key = "height" if config.size is None else "size"
            raise ConfigError(
                f"system.add.{key}: the thing has no height when it stands. Give system.add.scale instead"
            )
        return wanted / stands.height

    def foot(self, scene: Gaussians, radius: float, height: float) -> Tensor:
        """The point [3] that a thing of this size stands on."""
        config = self.config
        if config.position is not None:
            return torch.tensor(config.position).double() - torch.tensor(self.origin).double()
        names = [view.name for view in self.capture.views]
        number = view_number(str(config.view), names, "system.add.view")
        camera, where = self.capture.cameras([number]), "system.add.pixel"
        x, y = pixel_place(config.pixel or (0.0, 0.0), camera.width, camera.height)
        ground = ground_at(scene, camera, x, y, self.draw)
        if ground is None:
            raise SceneError(
                f"{where}: view '{names[number]}' shows no surface at ({x:.0f}, {y:.0f}), only background. Choose a "
                "pixel of the ground, or give system.add.position"
            )
        require_level(ground, self.up, where)
        above = level_under(scene, ground.point, self.up, radius, height, self.draw)
        return ground.at_level(self.up.to(ground.point), above)

    def warn_of_size(self, there: Gaussians) -> None:
        """Say so where a thing is surely in other units than the scene."""
        stands, extent = stance(there, self.up), self.capture.extent
        size = max(stands.height, 2 * stands.radius)
        if not extent / LARGE**2 <= size <= LARGE * extent:
            plugin.warn(
                f"system.add: the thing is {size:.3g} across, and the scene's extent is {extent:.3g}: is it in other "
                "units? system.add.size=0.2 makes it a fifth of the extent"
            )

    # --- how it is lit

    def light(self, scene: Gaussians, there: Gaussians) -> Tensor:
        """RGB factors [M,3] of the thing's colours."""
        config, ones = self.config, there.means.new_ones(len(there), 3)
        if config.gain is not None:
            ones = ones * there.means.new_tensor(config.gain)
        elif config.light != "off":
            ones = ones * light.brightness(self.pictures(scene)).to(ones)
        if config.light != "shading" or not self.thing.surface:
            return ones
        facing, seen = faced(there, around(there))
        lamp = self.lamp(scene, there).to(facing)
        if self.thing.lit:
            return ones * (facing @ (lamp - light.lamp(there, facing, seen))).exp()
        return ones * (facing @ lamp - lamp.norm(dim=0)).exp()  # as painted where it is lit best, and darker elsewhere

    def lamp(self, scene: Gaussians, there: Gaussians) -> Tensor:
        """How light depends on the normal around the thing, as far as the cameras' own circle reaches."""
        near = (scene.means - there.means.mean(dim=0)).norm(dim=1) <= self.capture.extent
        if not bool(near.any()):
            return scene.means.new_zeros(3, 3)
        train = self.capture.train
        cameras = [self.capture.cameras([i]) for i in train[:: max(1, len(train) // VIEWPOINTS)]]
        facing, seen = faced(scene, cameras)
        return light.lamp(scene[near], facing[near], seen[near])

    def pictures(self, scene: Gaussians) -> Tensor:
        """Pixels [P,3] of some views, those that show something."""
        train = self.capture.train
        some = [train[i] for i in sorted({round(k * (len(train) - 1) / (LOOKED_AT - 1)) for k in range(LOOKED_AT)})]
        found = []
        for number in some:
            drawn = self.draw(scene, self.capture.cameras([number]))
            found.append(drawn.rgb[0][drawn.alpha[0, ..., 0] > 0.5])
        return torch.cat(found)


def faced(scene: Gaussians, cameras: Sequence[Cameras]) -> tuple[Tensor, Tensor]:
    """The normals [N,3] of splats, on the side from which these views see them, and in how many pixels [N] they do."""
    towards, seen = torch.zeros_like(scene.means), torch.zeros_like(scene.logit_opacities)
    for camera in cameras:
        everywhere = scene.means.new_ones(1, camera.height, camera.width)
        pixels = lift(scene, camera, everywhere).total
        seen += pixels
        directions = torch.nn.functional.normalize(camera.centers.to(scene.means) - scene.means, dim=1)
        towards += (pixels + UNSEEN)[:, None] * directions
    return light.normals(scene, towards), seen


def around(thing: Gaussians) -> list[Cameras]:
    """Views of a thing from all sides."""
    middle = thing.means.mean(dim=0)
    radius = (thing.means - middle).norm(dim=1).max()
    eyes = middle + 3 * radius * sphere_points(VIEWPOINTS).to(middle)
    viewmats = look_at(eyes, middle, middle.new_tensor([0.0, 0.0, 1.0]))
    focal, half = 2.5 * SIDE / 2, SIDE / 2
    K = middle.new_tensor([[focal, 0, half], [0, focal, half], [0, 0, 1]]).repeat(VIEWPOINTS, 1, 1)
    cameras = Cameras(viewmats, K, SIDE, SIDE)
    return [cameras[k] for k in range(VIEWPOINTS)]


def signed_axis(name: str) -> Tensor:
    """The direction [3] of "z", "-y" ..."""
    return torch.eye(3).double()[AXES[name]] * (-1 if name.startswith("-") else 1)


def pixel_place(pixel: Sequence[float], width: int, height: int) -> tuple[float, float]:
    """Where a pixel lies in a render. Raises ConfigError where that is outside of it."""
    x, y = pixel
    if x <= 1 and y <= 1:
        x, y = min(x * width, width - 0.5), min(y * height, height - 0.5)
    if not (x < width and y < height):
        raise ConfigError(
            f"system.add.pixel: got {list(pixel)}, expected a place inside of the view, {width}x{height} pixels: from "
            f"[0, 0] to [{width - 1}, {height - 1}], or fractions of its sides."
        )
    return x, y
