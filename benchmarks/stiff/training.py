"""Training under bad conditions: twins of a short descent in both precisions, and whole runs through the launcher."""

from __future__ import annotations

import io
import json
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import torch
from dreamcatalyst.demo.worlds import make_world
from dreamcatalyst.errors import SceneError
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians
from dreamcatalyst.scene.mask import threshold
from dreamcatalyst.scene.ply import read_ply, write_ply
from dreamcatalyst.scene.plyfile import read_vertices
from dreamcatalyst.scene.trainable import Splats
from dreamcatalyst.train.densify import DensifyConfig, densify, observe, screen_statistics
from dreamcatalyst.train.fit import FitMethod
from dreamcatalyst.train.optim import LearningRates
from torch import Tensor

from .anchors import ADAM
from .cases import Case, Check, bound, compare, refused, same
from .splats import FAR_AWAY, cloud, pinhole

ROOT = Path(__file__).resolve().parents[2]
STEPS = 5


# --- twins of a descent


def descent(
    dtype: torch.dtype,
    rounded: torch.dtype,
    spike: float = 1.0,
    faster: float = 1.0,
    offset: float = 0.0,
    every: int = 0,
) -> tuple[Gaussians, float]:
    """Splats after STEPS steps of Adam towards the picture of other colours, and the largest move of a parameter in a
    step, in learning rates. spike: what the loss of one step is multiplied by; faster: factor on all learning rates;
    offset: how far splats stand to the side; every: steps between two densifications, 0 for none."""
    scene = cloud()
    target = rasterize(scene, pinhole(), backend="reference").rgb.flip(-1).to(rounded).to(dtype)
    scene.means[:, 0].add_(offset)
    scene = scene.to(dtype=rounded).to(dtype=dtype)
    camera = pinhole().to(dtype=rounded).to(dtype=dtype)
    splats, rates = Splats(scene), LearningRates().at(0, 1, 1.0)
    splats.state.update(screen_statistics(splats))
    optimizer, most = splats.make_optimizer({name: faster * rate for name, rate in rates.items()}), 0.0
    config = DensifyConfig(every=1, grad_threshold=1e-9, top_fraction=0.1, max_size=0.0)
    for step in range(STEPS):
        render = rasterize(splats.scene, camera, backend="reference" if dtype == torch.float64 else "cpu")
        render.means2d.retain_grad()
        optimizer.zero_grad()
        ((spike if step == STEPS // 2 else 1.0) * (render.rgb - target).square().mean()).backward()
        observe(splats, render)
        before = {name: value.detach().clone() for name, value in splats.parameters.items()}
        optimizer.step()
        moves = [(v.detach() - before[n]).abs().max() / (faster * rates[n]) for n, v in splats.parameters.items()]
        most = max(most, float(torch.stack(moves).max()))
        if every and step % every == 0:
            densify(splats, config, 1.0, torch.Generator().manual_seed(step))
    return splats.scene.detach(), most


def twins(**options: float) -> Callable[[], list[Check]]:
    """A case: the descent in float32 by the compiled renderer against float64, by the picture that it ends in; and that
    no step is larger than Adam's bound."""

    def run() -> list[Check]:
        half, full = torch.float32, torch.float64
        scenes = [descent(*types, **options) for types in ((half, half), (full, full), (full, half))]
        pictures = [rasterize(s.to(dtype=full), pinhole(), backend="reference").rgb for s, _ in scenes]
        finite = all(bool(value.isfinite().all()) for _, value in scenes[0][0].parameters())
        check = compare("picture after 5 steps", *pictures)
        largest = bound("largest move, learning rates", scenes[0][1], ADAM)
        return [Check(check.quantity, check.finite and finite, check.error, check.tolerance), largest]

    return run


def all_pruned() -> list[Check]:
    """Density control that finds every splat too faint says so and changes nothing."""
    splats = Splats(cloud())
    splats.state.update(screen_statistics(splats))
    before = splats.parameters["means"].detach().clone()
    config = DensifyConfig(min_opacity=1.0)
    check = refused(SceneError, "every splat", lambda: densify(splats, config, 1.0, torch.Generator()))
    return [check, same("splats after it", splats.parameters["means"].detach(), before)]


def all_but_frozen_pruned() -> list[Check]:
    """Where frozen splats are left, all editable ones may go, and the rest is drawn and stepped as ever."""
    scene, editable = cloud().to(dtype=torch.float32), torch.arange(30) < 10
    splats = Splats(scene, editable=editable)
    splats.state.update(screen_statistics(splats))
    optimizer = splats.make_optimizer(dict.fromkeys(PARAMETERS, 1e-2))
    densify(splats, DensifyConfig(min_opacity=1.0), 1.0, torch.Generator())
    camera = pinhole().to(dtype=torch.float32)
    render = rasterize(splats.scene, camera)
    render.rgb.square().mean().backward()
    optimizer.step()
    return [
        bound("editable splats left", float(len(splats)), 0.0),
        same("picture of the frozen", rasterize(splats.scene, camera).rgb, rasterize(scene[~editable], camera).rgb),
    ]


def empty_mask() -> list[Check]:
    """A mask that finds nothing says so, and says what would be found."""
    return [refused(SceneError, "is empty", lambda: threshold(torch.full((30,), 0.2), 0.5))]


# --- whole runs

SMALL = ["data.width=24", "data.height=24", "trainer.accelerator=cpu", "use_timestamp=false", "tag=trial"]
SMALL += ["system.report.video_frames=0", "system.report.pictures=0", "system.report.every=0", "system.report.views=1"]
SMALL += ["trainer.limit_test_batches=0", "trainer.enable_progress_bar=false", "data.max_view_num=4"]
EACH = ["checkpoint.every_n_train_steps=1", "checkpoint.save_top_k=-1"]
GROWING = ["system.densify.every=1", "system.densify.start=0", "system.densify.stop=99"]
GROWING += ["system.densify.grad_threshold=1e-9", "system.densify.top_fraction=0.05"]


class Runs:
    """The launcher, in a folder of its own."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __call__(self, config: str, *options: str, name: str = "run") -> tuple[Path, int, str]:
        """The trial's folder, the exit status and what was said."""
        import launch

        arguments = ["--config", str(ROOT / "configs" / config), "--train", "data.source=demo:statue", *SMALL]
        arguments += [f"exp_root_dir={self.folder}", f"name={name}", *options]
        said = io.StringIO()
        with mock.patch.object(sys, "argv", ["launch.py", *arguments]), redirect_stdout(said), redirect_stderr(said):
            status = launch.main(arguments)
        return self.folder / name / "trial", status, said.getvalue()


@contextmanager
def runs() -> Iterator[Runs]:
    """A launcher whose runs are gone afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        yield Runs(Path(folder))


def last(trial: Path) -> Tensor:
    """All numbers of the splats that a run left."""
    return torch.cat([value.flatten() for _, value in read_ply(trial / "save" / "last.ply").parameters()])


def ended(status: int, wanted: int, said: str, *words: str) -> Check:
    """The run ended with this status and said all of these words."""
    missing = sum(re.search(word, said) is None for word in words)
    return Check("exit status and words", None, float((status != wanted) + missing), 0.0)


def finishes(*options: str, config: str = "closed-form.yaml") -> Callable[[], list[Check]]:
    """A case: the run comes to its end with finite splats."""

    def run() -> list[Check]:
        with runs() as launch:
            trial, status, said = launch(config, *options)
            splats = last(trial)
            return [ended(status, 0, said), bound("numbers that are not finite", float((~splats.isfinite()).sum()), 0)]

    return run


def stops(*words: str, options: list[str]) -> Callable[[], list[Check]]:
    """A case: the run ends with one clear error."""

    def run() -> list[Check]:
        with runs() as launch:
            _, status, said = launch("fit.yaml", *options)
            return [ended(status, 2, said, *words)]

    return run


def one_step() -> list[Check]:
    """Adam's first step moves what has a gradient by its learning rate, whatever the gradient."""
    with runs() as launch:
        trial, status, said = launch("closed-form.yaml", "trainer.max_steps=1")
        before, after = (read_ply(trial / "save" / name) for name in ("source.ply", "last.ply"))
    rates = {"quats": 1e-3, "log_scales": 5e-3, "logit_opacities": 5e-2, "sh0": 5e-2}
    moved = torch.stack([(getattr(after, n) - getattr(before, n)).abs().max() / rate for n, rate in rates.items()])
    ulp = max(float(getattr(before, n).abs().max()) * 2**-23 / rate for n, rate in rates.items())
    return [ended(status, 0, said), bound("largest move - 1, learning rates", float((moved - 1).abs().max()), ulp)]


def resumed() -> list[Check]:
    """Taken up at any of its steps, a run that densifies at every step ends in the same bits."""
    with runs() as launch:
        options = ["trainer.max_steps=4", *GROWING, *EACH]
        whole, *_ = launch("fit.yaml", *options, name="whole")
        checks = []
        for step in (1, 2, 3):
            (checkpoint,) = (whole / "ckpts").glob(f"*step={step}.ckpt")
            again, *_ = launch("fit.yaml", *options, f"resume={checkpoint}", name=f"from-{step}")
            left = again if (again / "save" / "last.ply").exists() else whole
            checks.append(same(f"splats, from step {step}", last(left), last(whole)))
        return checks


def far_away() -> list[Check]:
    """A world around 1e6, splats and cameras beside them: it is edited, and written where it was."""
    far, scene, folder_name = np.array(FAR_AWAY), make_world("statue").scene, "far"
    with runs() as launch:
        folder = launch.folder / folder_name
        given = write_ply(folder / "far.ply", scene, origin=FAR_AWAY)
        angles = np.arange(5) * 0.4
        entries = []
        for angle in angles:  # from all around, along x and y, with the third axis up
            forward = -np.array([np.cos(angle), np.sin(angle), 0.0])
            rotation = np.stack([np.array([-forward[1], forward[0], 0]) * -1, np.array([0, 0, -1.0]), forward], axis=1)
            place = far - 3 * forward + [0, 0, 0.6]
            lens = {"width": 24, "height": 24, "fx": 30.0, "fy": 30.0}
            entries.append({"position": place.tolist(), "rotation": rotation.tolist(), **lens})
        (folder / "cameras.json").write_text(json.dumps(entries))
        trial, status, said = launch(
            "closed-form.yaml", "trainer.max_steps=2", f"system.gs_source={given}", "data.source="
        )
        source, last_ = (read_vertices(trial / "save" / name).columns for name in ("source.ply", "last.ply"))
        truth = scene.means.double()
        back, moved = (torch.from_numpy(np.stack([c[name] for name in "xyz"], axis=1) - far) for c in (source, last_))
    rate = 2 * 1.6e-4 * 10  # of the means, in an extent of less than 10
    return [
        ended(status, 0, said),
        compare("positions of source.ply", back, truth, truth),
        bound("moved at most", float((moved - truth).abs().max()), rate),
        bound("colours that did not move", float((source["f_dc_0"] == last_["f_dc_0"]).mean()), 0.9),
    ]


@contextmanager
def poisoned(at: int, factor: float) -> Iterator[None]:
    """Fits whose loss has at step `at` a derivative times `factor`."""
    step_loss = FitMethod.step_loss

    def poisoned_loss(self, batch, number):
        terms, *others = step_loss(self, batch, number)
        if number == at:
            terms["photometric"].register_hook(lambda gradient: gradient * factor)
        return terms, *others

    with mock.patch.object(FitMethod, "step_loss", poisoned_loss):
        yield


def infinite_view(nonfinite: str) -> Callable[[], list[Check]]:
    """A case: one view's derivative is infinite. The run stops with the place and the last good state, from which it
    can go on; or leaves the step out."""

    def run() -> list[Check]:
        options = ["trainer.max_steps=5", f"system.nonfinite={nonfinite}"]
        with runs() as launch:
            with poisoned(at=3, factor=float("inf")):
                trial, status, said = launch("fit.yaml", *options, name="poisoned")
            splats = last(trial)
            bad = bound("numbers that are not finite", float((~splats.isfinite()).sum()), 0.0)
            if nonfinite == "skip":
                return [ended(status, 0, said), bad]
            whole, *_ = launch("fit.yaml", *options, name="whole")
            launch("fit.yaml", *options, f"resume={trial / 'ckpts' / 'last.ckpt'}", name="poisoned")
            good = same("splats of the run taken up, without", last(trial), last(whole))
            return [ended(status, 2, said, "step 3", "view", "not finite"), bad, good]

    return run


def nothing_visible() -> list[Check]:
    """Splats that no camera sees have no derivative: an edit leaves them as they are."""
    with runs() as launch:
        scene = make_world("statue").scene
        away = write_ply(launch.folder / "away.ply", replace(scene, means=scene.means + 1e4))
        trial, status, said = launch("closed-form.yaml", "trainer.max_steps=3", f"system.gs_source={away}")
        before = torch.cat([value.flatten() for _, value in read_ply(away).parameters()])
        return [ended(status, 0, said), same("splats", last(trial), before)]


FAST = [f"system.learning_rates.{name}" for name in ("means=0.016", "quats=0.1", "scales=0.5", "opacities=5", "sh0=5")]
CASES = [
    Case("training", name, run)
    for name, run in {
        "a short descent": twins(),
        "one gradient times 1e6": twins(spike=1e6),
        "one gradient times 1e-12": twins(spike=1e-12),
        "learning rates 100 times too high": twins(faster=100.0),
        "nothing in sight": twins(offset=1e3),
        "densified at every step": twins(every=1),
        "all splats pruned": all_pruned,
        "all but frozen splats pruned": all_but_frozen_pruned,
        "an empty mask": empty_mask,
        "a run with learning rates 100 times too high": finishes("trainer.max_steps=20", *FAST),
        "a run that densifies at every step": finishes("trainer.max_steps=6", *GROWING),
        "a run in which all splats are pruned": stops(
            "every splat", options=["trainer.max_steps=3", *GROWING, "system.densify.min_opacity=0.9999"]
        ),
        "a run that sees nothing": nothing_visible,
        "a run with an infinite derivative": infinite_view("stop"),
        "a run with an infinite derivative, left out": infinite_view("skip"),
        "a run of one step": one_step,
        "a run taken up at any step": resumed,
        "a run in a world around 1e6": far_away,
    }.items()
]
