"""Deletions: masks that name nothing or everything, inpainters that are none, and checkpoints of something else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from .cases import Case, Place, case
from .masks import box, files, picture
from .things import HEIGHT, SCENE, WIDTH, link_files, make

deletion = partial(case, "deletion", config="delete")
LUMP = [*SCENE, "system.thing=lump", *box(low=[-0.1, -0.2, -0.2], high=[0.4, 0.3, 0.3])]
MODEL = ["system.inpaint.kind=stable-diffusion"]


def scene(*more: str) -> Callable[[Place], Sequence[str]]:
    """A deletion from a scene of one's own."""

    def given(place: Place) -> Sequence[str]:
        place.copy("scene.ply")
        place.copy("capture")
        return [*LUMP, *more]

    return given


def by_model(*more: str) -> Callable[[Place], Sequence[str]]:
    """One with the folder `model`, of InstructPix2Pix."""

    def given(place: Place) -> Sequence[str]:
        link_files(make(place.shop, "model"), place / "model")
        return [*scene()(place), *MODEL, *more]

    return given


CASES: list[Case] = [
    deletion("a lump in the open, behind which nothing is to be healed", scene(), "taken away", status=0),
    deletion("no mask", lambda p: [*scene()(p)[:-2], "system.mask.kind=none"], "none names nothing", "box"),
    deletion("a kind of mask with a typo", lambda p: [*scene()(p)[:-2], "system.mask.kind=bx"], "'bx'", "'box'"),
    deletion("a box that holds nothing", scene(*box(low=[90, 0, 0], high=[91, 1, 1])), "is empty"),
    deletion("a box that holds everything", scene(*box(low=[-9, -9, -9], high=[9, 9, 9])), "all 60"),
    deletion(
        "masks that are all black",
        lambda p: [*files(lambda f: [picture(x, WIDTH, HEIGHT) for x in list(f.iterdir())])(p), "system.thing=lump"],
        "is empty",
    ),
    deletion("an inpainter with a typo", scene("system.inpaint.kind=telia"), "'telia'", "'telea'"),
    deletion("an option of another inpainter", scene("system.inpaint.options={radius: 0.1}"), "'radius'", "quality"),
    deletion("a radius below nothing", scene("system.inpaint={kind: telea, options: {radius: -1}}"), "radius: got -1"),
    deletion("a quality that is none", scene("system.inpaint={kind: fsr, options: {quality: bets}}"), "'best'"),
    deletion("no views to look at", scene("system.heal.views=0"), "views"),
    deletion("a border as wide as two pictures", scene("system.heal.border=2"), "border"),
    deletion("a model that is not there", scene(*MODEL, "system.inpaint.options={path: ./model}"), "no such folder"),
    deletion("an id of the hub, without network", scene(*MODEL, "system.inpaint.options={path: a/b}"), "a/b"),
    deletion("a model of another kind", by_model("system.inpaint.options={path: model}"), "for inpainting"),
    deletion(
        "a precision that is none",
        by_model("system.inpaint.options={path: model, dtype: fp8}"),
        "'fp8'",
        "fp16",
    ),
    deletion("no splats and no photographs", ["data.source=''"], "gs_source"),
]
