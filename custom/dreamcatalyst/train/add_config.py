"""The section of a config that says what is put into a scene, and where."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..config import AtLeastOne, NonNegative, Number, Positive
from ..demo.capture import PREFIX
from ..errors import ConfigError, choose
from .edit_config import EditParts, PromptConfig

Point = tuple[Number, Number, Number]
AXES = ("x", "y", "z", "-x", "-y", "-z")
LIGHTS = ("shading", "gain", "off")
Y_UP = (".glb", ".gltf", ".obj", ".dae", ".vrml")  # these formats have things stand along y, by what they say or by use


@dataclass(frozen=True)
class AddConfig:
    """A thing that is put into the scene: at its own coordinates, or standing with its foot (the middle of its outline,
    at its lowest) at a position, or on what a pixel of a view shows."""

    path: str = ""  # splats, a mesh or a point cloud; demo:<world>: the first thing of a synthetic scene
    position: Point | None = None  # of its foot, world units
    view: str | None = None  # name or number of the view whose pixel it stands on
    pixel: tuple[NonNegative, NonNegative] | None = None  # x, y from the upper left corner: pixels of the render, or
    # fractions of its sides where neither is over 1
    rotation: tuple[Number, ...] = (0.0, 0.0, 0.0)  # degrees about the world's x, then y, then z; or a quaternion wxyz
    scale: Positive | None = None  # times as large as it is; 1, unless there is one of the next two
    height: Positive | None = None  # its height when it stands, world units
    size: Positive | None = None  # its height when it stands, a fraction of the scene's extent
    up: str = "auto"  # which of its own axes stands up: x | y | z | -x | -y | -z; auto: by its format
    light: str = "shading"  # how its colours are brought into the scene's light: shading | gain | off
    gain: tuple[Positive, Positive, Positive] | None = None  # RGB factors of its colours; null: found, unless off
    splats: AtLeastOne = 20_000  # that a mesh becomes, and a point cloud at most

    def __post_init__(self) -> None:
        choose("axis", self.up, ("auto", *AXES), "up")
        choose("light", self.light, LIGHTS, "light")
        if not self.path.strip():
            raise ConfigError("path: is empty. Name what is put in: splats, a mesh, a point cloud, or demo:<world>")
        if len(self.rotation) not in (3, 4):
            got = len(self.rotation)
            raise ConfigError(f"rotation: got {got} numbers, expected 3 angles in degrees, or a quaternion wxyz.")
        if len(self.rotation) == 4 and not any(self.rotation):
            raise ConfigError("rotation: got a quaternion of zeros, which is no rotation; [1, 0, 0, 0] turns nothing.")
        if self.position is not None and (self.pixel is not None or self.view is not None):
            raise ConfigError("position: given beside view and pixel, expected one place: set the others to null.")
        if (self.view is None) != (self.pixel is None):
            lacking = "view" if self.view is None else "pixel"
            raise ConfigError(f"{lacking}: is missing: a place in a picture is a view and a pixel of it.")
        sizes = [name for name in ("scale", "height", "size") if getattr(self, name) is not None]
        if len(sizes) > 1:
            raise ConfigError(f"{sizes[0]}: given beside {', '.join(sizes[1:])}, expected one of scale, height, size.")

    @property
    def stands(self) -> bool:
        """Whether it is stood somewhere, and not left at its own coordinates."""
        return self.position is not None or self.pixel is not None

    @property
    def made(self) -> bool:
        """Whether it is of a synthetic scene."""
        return self.path.startswith(PREFIX)

    def axis(self, splats: bool, orbit_up: str) -> str:
        """Which of its own axes stands up. splats: whether it is a file of such. orbit_up: what is up in those."""
        if self.up != "auto":
            return self.up
        if self.made:
            return "z"
        if splats:  # whatever the format: all are read into the PLY's axes
            return orbit_up
        return "y" if Path(self.path).suffix.lower() in Y_UP else "z"


@dataclass(frozen=True)
class AddPromptConfig(PromptConfig):
    """What is wanted of the thing once it is there, in words; empty: nothing."""

    def __post_init__(self) -> None:
        """Without words there is no edit, and nothing to be checked."""


@dataclass(frozen=True)
class AddParts(EditParts):
    """The parsed sections of a run that puts a thing in."""

    prompt_processor: AddPromptConfig
    add: AddConfig
