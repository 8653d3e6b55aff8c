"""Checkpoints: of another run, damaged, or no checkpoint at all; and runs that go on with other values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch

from .cases import Case, Outcome, Place, case
from .things import NAMED, SCENE, STEPS, TRIAL

G = "resume"
resume = partial(case, G)
CHANGED = [  # what the checkpoint does not say: a resume is the same run, or an error that names the key
    ("another instruction", "system.prompt_processor.prompt=Make it snow", "prompt"),
    ("another rule", "system.guidance.rule=dds", "rule"),
    ("another seed", "seed=7", "seed"),
    ("another seed of the data alone", "data.seed=7", "seed"),
    ("another size", "data.max_side=16", "max_side"),
    ("another guidance scale", "system.guidance.guidance_scale=3", "guidance_scale"),
    ("another image guidance scale", "system.guidance.condition_scale=3", "condition_scale"),
    ("another prior", "system.guidance.prior.s=0.2", "prior"),
    ("another noise", "system.guidance.noise=independent", "noise"),
    ("another learning rate", "system.learning_rates.sh0=1e-4", "sh0"),
    ("another memory of Adam", "system.learning_rates.beta2=0.9", "beta2"),
    ("densification", "system.densify.every=1", "densify"),
    ("anchors", "system.anchor.kind=source", "anchor"),
    ("a mask", "system.mask={kind: box, options: {low: [0, 0, 0], high: [1, 1, 1]}}", "mask"),
    ("other views", "data.test_every=4", "test_every"),
    ("more views a step", "data.batch_size=2", "batch_size"),
    ("another background", "system.renderer.background=[1,1,1]", "background"),
    ("another capture", "data.source=demo:statue", "source"),
]


def on(*more: str, thing: str = "edit", step: int = 2) -> Callable[[Place], Sequence[str]]:
    """A run that goes on from a checkpoint of the finished trial."""

    def given(place: Place) -> Sequence[str]:
        place.take(thing)
        return [*SCENE, *STEPS, *NAMED, f"resume={checkpoint(place, step)}", *more]

    return given


def checkpoint(place: Place, step: int = 2) -> Path:
    """The checkpoint of a step; of the last step, last.ckpt."""
    (folder,) = place.work.glob("outputs/*/trial/ckpts")
    found = folder / "last.ckpt" if step == 4 else next(folder.glob(f"*step={step}.ckpt"))
    return found.relative_to(place.work)


def spoiled(spoil: Callable[[Path], object], *more: str) -> Callable[[Place], Sequence[str]]:
    """A run that goes on from a checkpoint that `spoil` has changed."""

    def given(place: Place) -> Sequence[str]:
        arguments = on(*more)(place)
        spoil(place.work / checkpoint(place))
        return arguments

    return given


def of(content: Callable[[Place], object]) -> Callable[[Place], Sequence[str]]:
    """A run that goes on from another file."""

    def given(place: Place) -> Sequence[str]:
        place.take("edit")
        return [*SCENE, *STEPS, f"resume={content(place)}"]

    return given


def saved(place: Place, state: object) -> str:
    torch.save(state, place / "other.ckpt")
    return "other.ckpt"


def lacking(key: str) -> Callable[[Path], None]:
    """The checkpoint without one of its parts, saved as any program may."""

    def spoil(path: Path) -> None:
        state = torch.load(path, weights_only=True)
        del state[key]
        torch.save(state, path)

    return spoil


def flip(share: float) -> Callable[[Path], None]:
    """One bit at this place of the file."""

    def spoil(path: Path) -> None:
        data = bytearray(path.read_bytes())
        data[int(len(data) * share)] ^= 1
        path.write_bytes(data)

    return spoil


def cut(share: float) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)]) and None


def other_ply(place: Place) -> Sequence[str]:
    arguments = on("system.gs_source=other.ply")(place)
    (place / "other.ply").write_bytes((place / "scene.ply").read_bytes()[:-4] + b"\0\0\x80\x3f")
    return arguments


def went_on(place: Place, outcome: Outcome) -> list[str]:
    state = torch.load(place.work / TRIAL / "ckpts/last.ckpt", weights_only=True)
    return [] if state["global_step"] >= 4 else ["did not go on to the end"]


def moved(place: Place) -> Sequence[str]:
    """Inputs that are gone since."""
    arguments = on()(place)
    (place / "scene.ply").rename(place / "moved.ply")
    return arguments


CASES: list[Case] = [
    resume("from step 2 of 4, unchanged", on(), "wrote", status=0, check=went_on, seconds=30),
    resume("with reports at other steps", on("system.report.every=1"), "wrote", status=0, check=went_on, seconds=30),
    *(resume(f"with {name}: {key}", on(key), says) for name, key, says in CHANGED),
    resume("with another PLY under another name", other_ply, "gs_source"),
    resume("of a finished run", on(step=4), "resume"),
    resume("with fewer steps than are done", on("trainer.max_steps=1"), "max_steps"),
    resume("after the splats were moved", moved, "scene.ply"),
    resume("a file that is not there", ["resume=outputs/none/ckpts/last.ckpt"], "resume", "there is no checkpoint"),
    resume(
        "a step that is not there",
        on("resume=outputs/closed-form/trial/ckpts/epoch=0-step=3.ckpt"),
        "there is no checkpoint",
        "Did you mean",
    ),
    resume("the trial's folder", of(lambda p: TRIAL), "resume"),
    resume("the folder ckpts", of(lambda p: f"{TRIAL}/ckpts"), "resume"),
    resume("the PLY of the result", of(lambda p: f"{TRIAL}/save/last.ply"), "resume", "last.ply"),
    resume("its config", of(lambda p: f"{TRIAL}/configs/parsed.yaml"), "resume", "parsed.yaml"),
    resume("an empty file", of(lambda p: p.write("empty.ckpt", "").name), "resume", "empty.ckpt"),
    resume("a picture", of(lambda p: p.write("a.ckpt", b"\x89PNG\r\n\x1a\n" + bytes(99)).name), "resume", "a.ckpt"),
    resume("a zip archive", of(lambda p: p.write("a.ckpt", b"PK\x05\x06" + bytes(18)).name), "resume", "a.ckpt"),
    resume(
        "a pickle that would run code",
        of(lambda p: p.write("a.ckpt", b"cos\nsystem\n(S'touch run'\ntR.").name),
        "resume",
        "a.ckpt",
    ),
    resume("a tensor", of(lambda p: saved(p, torch.zeros(3))), "resume", "other.ckpt"),
    resume("a list", of(lambda p: saved(p, [1, 2])), "resume", "other.ckpt"),
    resume("weights alone", of(lambda p: saved(p, {"unet.weight": torch.zeros(3)})), "resume", "other.ckpt"),
    resume(
        "another project's Lightning checkpoint",
        of(
            lambda p: saved(
                p,
                {
                    "epoch": 0,
                    "global_step": 2,
                    "pytorch-lightning_version": "2.4.0",
                    "state_dict": {},
                    "loops": {},
                    "optimizer_states": [],
                    "lr_schedulers": [],
                },
            )
        ),
        "resume",
    ),
    *(
        resume(f"without its '{key}'", spoiled(lacking(key)), "resume", key)
        for key in ("splats", "run", "guidance", "optimizer_states", "global_step", "loops", "state_dict")
    ),
    *(resume(f"cut off at {share:.0%}", spoiled(cut(share)), "resume") for share in (0.1, 0.5, 0.99)),
    *(
        resume(f"one bit flipped at {share:.0%}", spoiled(flip(share)), "resume")
        for share in (0.0, 0.3, 0.5, 0.7, 0.99)
    ),
    *(
        resume(f"one bit flipped, {mode}", spoiled(flip(0.5), mode), "resume")
        for mode in ("--test", "--validate", "--export")
    ),
    resume("a fit's checkpoint for an edit", lambda p: [*on(thing="fit")(p)], "resume", "fit"),
    case(G, "an edit's checkpoint for a fit", on(), "resume", config="fit"),
    case(G, "weights that are not there", ["system.weights=none.ckpt"], "weights"),
    case(G, "weights that are a PLY", lambda p: [f"system.weights={p.copy('scene.ply').name}"], "weights"),
]
