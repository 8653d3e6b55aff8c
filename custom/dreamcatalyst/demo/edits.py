"""The edits of synthetic scenes, by name and by instruction, each with the truth in 3D."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from ..data.truth import normalised
from ..errors import choose
from ..scene.gaussians import Gaussians
from .additions import party_hat, rabbit_ears, scarf, with_addition
from .coats import (
    BRONZE,
    GOLD,
    GRIZZLY_SHAPE,
    PANDA_SHAPE,
    POLAR_SHAPE,
    dress,
    grizzly,
    metal,
    paint,
    panda,
    polar_bear,
)
from .seasons import autumn, night, snow, sunset
from .worlds import World

NOTHING = "nothing"  # the edit that leaves a world as it is
INVISIBLE = -20.0  # logit of an opacity of 2e-9: renderers leave out what is under 1/255


@dataclass(frozen=True)
class WorldEdit:
    """One thing that can be asked for.

    name: of the edit. scope: "object" (only the target changes) or "global". phrases: the instructions that ask for it,
    the paper's wording first. target: the thing that changes, None for global ones. weight: how often training draws
    it, 0 for what it was never taught. apply: World -> Gaussians, as many splats in the same order; where the edit
    `adds` something, those of the world, to the bit, and then its own. indoors: whether it makes sense in a room.
    """

    name: str
    scope: str
    phrases: tuple[str, ...]
    apply: Callable[[World], Gaussians]
    target: str | None = None
    weight: float = 1.0
    indoors: bool = True
    adds: bool = False


def _turned_into(name: str) -> tuple[str, ...]:
    it = f"a {name}"
    return (
        f"Turn the bear statue into {it}",
        f"Make the bear statue {it}",
        f"Turn the bear into {it}",
        f"Turn the statue into {it}",
        f"Turn it into {it}",
        f"Make it {it}",
        f"Make the bear look like {it}",
        f"Change the bear statue to {it}",
        f"Replace the statue with {it}",
        f"It should be {it}",
        it.capitalize(),
        name.capitalize(),
    )


def _painted(thing: str, color: str) -> tuple[str, ...]:
    short = {"bear statue": ("bear", "statue"), "flower pot": ("pot",)}.get(thing, ())
    phrases = [f"Turn the {thing} {color}", f"Make the {thing} {color}", f"Paint the {thing} {color}"]
    phrases += [f"Change the color of the {thing} to {color}", f"{color.capitalize()} {thing}", f"A {color} {thing}"]
    for name in short:
        phrases += [f"Turn the {name} {color}", f"Make the {name} {color}", f"Paint the {name} {color}"]
    return tuple(phrases)


PAINTS = {
    "red": (0.78, 0.13, 0.11),
    "blue": (0.14, 0.30, 0.76),
    "green": (0.18, 0.55, 0.20),
    "yellow": (0.92, 0.76, 0.14),
    "purple": (0.48, 0.20, 0.62),
    "white": (0.95, 0.94, 0.92),
}
THINGS = ("bear statue", "ball", "box", "flower pot")


def _animals() -> list[WorldEdit]:
    bears = {
        "panda": (panda, PANDA_SHAPE, ("Turn it into a panda bear", "Give the bear the fur of a panda"), 7.0),
        "polar bear": (polar_bear, POLAR_SHAPE, ("Give the bear the fur of a polar bear",), 3.0),
        "grizzly bear": (grizzly, GRIZZLY_SHAPE, ("Turn the statue into a brown bear", "Turn it into a grizzly"), 3.0),
    }
    return [
        WorldEdit(
            name, "object", _turned_into(name) + more, partial(dress, coat=coat, shape=shape), "bear statue", weight
        )
        for name, (coat, shape, more, weight) in bears.items()
    ]


def _metals() -> list[WorldEdit]:
    bronze = _turned_into("bronze statue") + (
        "Make the bear bronze",
        "Make the statue out of bronze",
        "Cast the bear in bronze",
    )
    metals = [
        WorldEdit(
            "bronze statue", "object", bronze, partial(metal, thing="bear statue", stops=BRONZE), "bear statue", 3.0
        )
    ]
    for thing in THINGS:
        gold = _painted(thing, "golden") + (f"Make the {thing} gold", f"Turn the {thing} into gold")
        gold += _turned_into("golden statue") if thing == "bear statue" else ()
        weight = 2.0 if thing == "bear statue" else 0.3
        metals.append(
            WorldEdit(f"golden {thing}", "object", gold, partial(metal, thing=thing, stops=GOLD), thing, weight)
        )
    return metals


def _paints() -> list[WorldEdit]:
    return [
        WorldEdit(
            f"{color} {thing}",
            "object",
            _painted(thing, color),
            partial(paint, thing=thing, color=rgb),
            thing,
            0.7 if thing == "bear statue" else 0.3,
        )
        for thing in THINGS
        for color, rgb in PAINTS.items()
    ]


def _given(a: str, name: str, more: tuple[str, ...]) -> tuple[str, ...]:
    thing = f"{a}{name}"
    phrases = (f"Give the bear {thing}", f"Put {thing} on the bear", f"Give the bear statue {thing}")
    return (*phrases, f"Add {thing} to the bear", f"Add {thing}", thing.capitalize(), *more)


def _additions() -> list[WorldEdit]:
    table = (
        ("party hat", "hat", party_hat, _given("a ", "party hat", ("Make the bear wear a party hat",))),
        ("rabbit ears", "rabbit ear", rabbit_ears, _given("", "rabbit ears", ("Give the bear the ears of a rabbit",))),
        ("scarf", "scarf", scarf, _given("a ", "scarf", ("Make the bear wear a scarf",))),
    )
    return [
        WorldEdit(name, "object", phrases, partial(with_addition, make=make, part=part), "bear statue", 0.0, adds=True)
        for name, part, make, phrases in table
    ]


def without(world: World, thing: str) -> Gaussians:
    """The world's splats in the same order, those of `thing` so transparent that no renderer draws them."""
    first, last = world.thing(thing).rows
    logits = world.scene.logit_opacities.clone()
    logits[first:last] = INVISIBLE
    return replace(world.scene, logit_opacities=logits)


def _removals() -> list[WorldEdit]:
    words = ("Remove", "Delete", "Take away", "Erase", "Get rid of", "Cut out")
    return [
        WorldEdit(
            f"no {thing}",
            "object",
            tuple(f"{word} the {thing}" for word in words),
            partial(without, thing=thing),
            thing,
            0.0,
        )
        for thing in THINGS
    ]


HOURS_AND_SEASONS = (  # name, function, whether in a room too, phrases; the paper's wording first
    (
        "sunset",
        sunset,
        True,
        (
            "Make it sunset",
            "Make it a sunset",
            "Turn it into a sunset",
            "Turn it into sunset",
            "Make it look like sunset",
        )
        + ("Make the scene sunset", "Make it look like it is sunset", "Change the time of day to sunset")
        + ("At sunset", "Sunset"),
    ),
    (
        "autumn",
        autumn,
        False,
        ("Make it autumn", "Make it fall", "Turn it into autumn", "Make it look like autumn", "Make it look like fall")
        + ("Make the scene autumn", "Make it look like autumn has come", "Change the season to autumn")
        + ("Turn the leaves orange", "In autumn", "Autumn"),
    ),
    (
        "snow",
        snow,
        False,
        ("Make it look like just snowed", "Make it look like it just snowed", "Make it winter", "Turn it into winter")
        + ("Make it look like winter", "Make the scene snowy", "Make it snowy", "Change the season to winter")
        + ("Cover it with snow", "Add snow", "Let it snow", "Snow"),
    ),
    (
        "night",
        night,
        True,
        ("Make it night", "Make it night time", "Turn it into night", "Make it look like night", "Make the scene night")
        + ("Make it midnight", "Make it dark", "Change the time of day to night", "At night", "Night"),
    ),
)
NO_CHANGE = ("", "Leave it as it is", "Change nothing", "Do nothing", "Keep it the same", "No change")


def _table() -> dict[str, WorldEdit]:
    edits = [*_animals(), *_metals(), *_paints()]
    edits += [
        WorldEdit(name, "global", phrases, apply, weight=2.2, indoors=indoors)
        for name, apply, indoors, phrases in HOURS_AND_SEASONS
    ]
    edits.append(WorldEdit(NOTHING, "global", NO_CHANGE, lambda world: world.scene, weight=1.5))
    edits += [*_additions(), *_removals()]
    return {edit.name: edit for edit in edits}


EDITS: dict[str, WorldEdit] = _table()


_BY_PHRASE = {normalised(phrase): edit for edit in EDITS.values() for phrase in edit.phrases}


def find_edit(instruction: str) -> WorldEdit | None:
    """The edit that `instruction` asks for, whatever its case, punctuation and spaces; None where it is unknown."""
    return _BY_PHRASE.get(normalised(instruction))


def possible(world: World) -> list[WorldEdit]:
    """The edits that make sense in `world`: their target stands in it, and weather needs a sky."""
    names = {thing.name for thing in world.things}
    return [e for e in EDITS.values() if (e.target is None or e.target in names) and (e.indoors or world.outdoors)]


def apply_edit(world: World, name: str) -> Gaussians:
    """The scene of `world` after the edit called `name`: as many splats, in the same order, with the same labels; an
    edit that adds something leaves all these as they are and appends its own.

    Object edits leave all splats but their target's as they are, to the bit. Recolourings and global edits change sh0
    alone, so that splats can be compared one by one; removals make their target transparent; the animals also move and
    scale the splats of some parts (ears, muzzle, trunk): those are compared by renders, which are exact from any
    viewpoint.
    Raises ConfigError for an unknown name or where the target is not in this world.
    """
    return EDITS[choose("edit", name, EDITS)].apply(world)
