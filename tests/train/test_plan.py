"""The plan of an edit, held against what the run really built and did."""

import json
from collections.abc import Callable

import pytest
import torch
from dreamcatalyst.train.density import DensifyConfig
from dreamcatalyst.train.editing import EditMethod
from dreamcatalyst.train.plan import Plan, readable, scene_bytes

from tests.train.test_confined import ANCHORED, MASK

ROWS = ["system.guidance.noise=independent"]


def tensor_size(*tensors: torch.Tensor) -> int:
    return sum(t.numel() * t.element_size() for t in tensors)


@pytest.fixture
def run(launch, monkeypatch) -> Callable[..., tuple[EditMethod, Plan, dict]]:
    """Launch and return the method after the run, its plan, and what was counted in its last step."""

    def go(*options: str):
        seen: dict = {"rows": 0, "pixels": 0}
        real = EditMethod.plan

        def spy(method):
            seen["method"], seen["plan"] = method, real(method)
            predict, draw = method.guidance.prior.predict_noise, method.draw_now

            def counted(rows, timestep):
                seen["rows"] += sum(len(row.noisy) for row in rows)
                return predict(rows, timestep)

            def drawn(cameras):
                render = draw(cameras)
                if torch.is_grad_enabled():
                    seen["pixels"] += render.rgb[..., 0].numel()
                return render

            monkeypatch.setattr(method.guidance.prior, "predict_noise", counted)
            monkeypatch.setattr(method, "draw_now", drawn)
            return seen["plan"]

        monkeypatch.setattr(EditMethod, "plan", spy)
        launch("closed-form.yaml", "trainer.max_steps=1", "system.report.every=0", *options)
        return seen["method"], seen["plan"], seen

    return go


def size(plan: Plan, name: str) -> int:
    return next(part.bytes for part in plan.builds if part.name == name)


@pytest.mark.parametrize(
    ("options", "rows"),
    [
        ([], 10),  # 3 + 2 rows, and each noise with both signs
        (ROWS, 5),
        ([*ROWS, "system.guidance.condition_scale=1"], 3),
        ([*ROWS, "system.guidance.rule=sds"], 3),
        ([*ROWS, "system.guidance.rule=csd-like"], 2),
        ([*ROWS, "system.guidance.rule=dds", "data.batch_size=2"], 10),
        (["system.guidance.rule=known-edit"], 0),
    ],
)
def test_rows_and_pixels_of_a_step(run, options, rows):
    _, plan, seen = run(*options)
    assert plan.network_rows == seen["rows"] == rows
    assert plan.pixels == seen["pixels"]


@pytest.mark.parametrize("options", [[], [MASK, "system.mask.feather=0.05"], [MASK, *ANCHORED], ANCHORED])
def test_memory_is_that_of_the_tensors(run, options):
    method, plan, _ = run(*options)
    splats = method.splats
    values = [t for p in splats.parameters.values() for t in (p, p.grad)]
    moments = [v for s in splats.optimizer.state.values() for k, v in s.items() if k != "step"]
    anchors = [v for k, v in splats.state.items() if k.startswith("anchor_") or k == "generation"]
    state = [v for k, v in splats.state.items() if not (k.startswith("anchor_") or k == "generation")]
    assert size(plan, "editable splats") == tensor_size(*values, *moments, *state)
    assert size(plan, "source") == scene_bytes(method.source.scene)
    if splats.frozen is not None:
        assert size(plan, "frozen splats") == scene_bytes(splats.frozen)
        assert 0 < method.frozen.kept.bytes <= size(plan, "renders of frozen splats")
    if anchors:
        assert size(plan, "anchors") == tensor_size(*anchors)


def test_a_fit_has_a_plan_without_a_prior(launch):
    trial = launch("fit.yaml", "trainer.max_steps=1")
    plan = json.loads((trial / "report" / "plan.json").read_text())
    assert {"editable splats", "view-dependent colour"} <= {part["name"] for part in plan["builds"]}
    assert plan["network_rows"] == 0 and not {"prior", "anchors"} & {part["name"] for part in plan["builds"]}


def test_what_is_left_out_is_not_there(run):
    method, plan, _ = run()
    assert {"frozen splats", "anchors", "perceptual network", "densification"} <= {p.name for p in plan.leaves_out}
    assert method.splats.frozen is None and method.frozen is None
    assert method.generations is None and not [k for k in method.splats.state if k.startswith("anchor_")]
    assert method.perceptual is None


def test_an_anchor_is_kept_for_what_weighs_only(run):
    method, plan, _ = run("system.anchor={kind: source, lambda_color: 0, lambda_geo: 0}")
    assert {k for k in method.splats.state if k.startswith("anchor_")} == {
        "anchor_logit_opacities",
        "anchor_log_scales",
    }
    assert {"anchor of means", "anchor of sh0"} <= {p.name for p in plan.leaves_out}


@pytest.mark.parametrize(
    ("start", "stop", "max_steps", "times"),
    [(100, 1201, 1500, 12), (100, 1200, 1500, 11), (100, 1201, 1200, 11), (1, 9, 1, 0), (500, 300, 900, 0)],
)
def test_times_of_densification(start, stop, max_steps, times):
    """As the training counts: after so many steps, from start on, before stop, and not after the last."""
    config = DensifyConfig(every=100, start=start, stop=stop)
    after = [n for n in range(1, max_steps) if start <= n < stop and n % 100 == 0]
    assert config.times(max_steps) == len(after) == times


def test_sizes_for_people():
    assert [readable(n) for n in (0, 900, 2048, 3 * 2**30)] == ["0 B", "900 B", "2 KiB", "3 GiB"]
