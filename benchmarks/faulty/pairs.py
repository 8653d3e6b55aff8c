"""Training pairs of one's own: shards that are junk, incomplete or of another kind."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .cases import Case, Place, command
from .things import pair_arrays

SMALL = [
    "data.count=8",
    "data.held_out=4",
    "data.size=32",
    "system.autoencoder.crop=32",
    "data.pairs=pairs",
    "trainer.max_steps=2",
    "system.autoencoder.steps=1",
    "system.unet.steps=1",
    "trainer.accelerator=cpu",
    "data.photographs=false",
]


def prior(name: str, given: object, *says: str, **options: object) -> Case:
    """A training of the small prior on spoiled pairs."""
    from .cases import ROOT

    def whole(place: Place) -> Sequence[str]:
        added = given(place) if callable(given) else given
        return ["--config", str(ROOT / "configs/prior.yaml"), *SMALL, *(added or [])]

    return command("pairs", name, whole, *says, **options)


def shard(change: Callable[[dict], object]) -> Callable[[Place], None]:
    """The second shard with other arrays."""

    def given(place: Place) -> None:
        path = place.copy("pairs") / "pairs-00001.npz"
        arrays = pair_arrays(1)
        change(arrays)
        np.savez(path, **arrays)

    return given


def raw(content: bytes) -> Callable[[Place], None]:
    return lambda place: place.copy("pairs") and place.write("pairs/pairs-00001.npz", content) and None


def cut(place: Place) -> None:
    path = place.copy("pairs") / "pairs-00001.npz"
    path.write_bytes(path.read_bytes()[:700])


def lone(place: Place) -> None:
    """A shard whose content is one array, and no archive."""
    path = place.copy("pairs") / "pairs-00001.npz"
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


CASES: list[Case] = [
    prior("a shard of junk", raw(b"junk" * 100), "pairs-00001.npz"),
    prior("an empty shard", raw(b""), "pairs-00001.npz"),
    prior("a shard cut off", cut, "pairs-00001.npz"),
    prior("a shard that is one array", lone, "pairs-00001.npz"),
    prior("a shard without masks", shard(lambda a: a.pop("mask")), "pairs-00001.npz", "mask"),
    prior("a shard without instructions", shard(lambda a: a.pop("instruction")), "pairs-00001.npz", "instruction"),
    prior("lists of unequal length", shard(lambda a: a.update(edited=a["edited"][:3])), "pairs-00001.npz", "edited"),
    prior("pictures of another size", shard(lambda a: a.update(pair_arrays(1, size=16))), "pairs-00001.npz"),
    prior("data.size of another size", lambda p: p.copy("pairs") and ["data.size=64"], "data.size"),
    prior("pictures as numbers from 0 to 1", shard(lambda a: a.update(source=a["source"] / 255)), "source", "uint8"),
    prior("pictures without colour", shard(lambda a: a.update(source=a["source"][..., 0])), "source"),
    prior("instructions that are numbers", shard(lambda a: a.update(instruction=np.arange(8))), "instruction"),
    prior("worlds that are text", shard(lambda a: a.update(world=a["edit"])), "world"),
    prior("objects that would run code", shard(lambda a: a.update(edit=np.array([{}] * 8, object))), "pairs-00001.npz"),
    prior("no pairs in a shard", shard(lambda a: a.update(pair_arrays(1, n=0))), "pairs-00001.npz"),
    prior("a file where the folder should be", lambda p: p.write("pairs", "x") and None, "pairs"),
    prior(
        "pairs.json that is junk", lambda p: p.copy("pairs") and p.write("pairs/pairs.json", "{") and None, "pairs.json"
    ),
    prior(
        "pairs.json of other settings",
        lambda p: p.copy("pairs") and p.write("pairs/pairs.json", '{"seed": 7, "size": 32, "shard": 250}') and None,
        "pairs",
        "seed",
    ),
    prior("more held out than there are", ["data.held_out=9"], "held_out"),
    prior("a count of 0", ["data.count=0"], "data", "count"),
    prior("a size that no autoencoder halves", lambda p: p.copy("pairs") and ["data.size=0"], "size"),
    prior(
        "channels that groups do not divide",
        lambda p: p.copy("pairs") and ["system.unet.channels=[50,96,192]"],
        "channels",
    ),
    prior("a negative learning rate", lambda p: p.copy("pairs") and ["system.unet.learning_rate=-1"], "learning_rate"),
    prior("no steps", lambda p: p.copy("pairs") and ["system.unet.steps=0"], "steps"),
    prior("a batch of 0", lambda p: p.copy("pairs") and ["system.unet.batch_size=0"], "batch_size"),
]
