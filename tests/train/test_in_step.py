"""Whatever is done to splats in whatever order, every number of a row stays that row's own, and frozen rows stay bits.

The model is a list of rows, each a dictionary of its own numbers that nothing can misalign: parameters, moments, and
state. It is moved by Kingma & Ba's formulas and by the rules of densification written for one row at a time.
"""

from __future__ import annotations

import io
import math

import pytest
import torch
from dreamcatalyst.errors import SceneError
from dreamcatalyst.scene.gaussians import PARAMETERS, Gaussians
from dreamcatalyst.scene.generations import ANCHORS, Generations
from dreamcatalyst.scene.trainable import Splats
from dreamcatalyst.train.densify import DensifyConfig, densify, reset_opacity, screen_statistics
from hypothesis import given, settings
from hypothesis import strategies as st

RATE, BETA1, BETA2 = 1e-2, 0.9, 0.999
RATES = dict.fromkeys(PARAMETERS, RATE)
OPERATIONS = ("densify", "append", "remove", "step", "step", "feather", "reset", "checkpoint")
Row = dict[str, torch.Tensor]


def feathered(n: int, g: torch.Generator) -> torch.Tensor:
    """A border that is 1 for about a third of the rows."""
    return torch.rand(n, generator=g).mul(1.5).clamp(0.1, 1)


class Twin:
    """Splats, and the list of rows that they should be."""

    def __init__(self, n: int, frozen: int, sh_degree: int, anchor: str) -> None:
        g = torch.Generator().manual_seed(n)
        scene = Gaussians.from_colors(
            torch.randn(n, 3, generator=g),
            torch.rand(n, 3, generator=g) + 0.5,
            torch.rand(n, 3, generator=g),
            torch.rand(n, generator=g) * 0.8 + 0.1,
            sh_degree=sh_degree,
        )
        scene = scene.with_extra(id=torch.arange(n), tag=torch.arange(2.0 * n).reshape(n, 2))
        editable = torch.randperm(n, generator=g) >= frozen
        self.generations = Generations(0.05, 0.1, 1.3, 10, anchor=anchor)
        self.splats = Splats(scene, {"update": feathered(n - frozen, g)}, editable)
        self.generations.begin(self.splats)
        self.splats.state.update(screen_statistics(self.splats))
        self.splats.make_optimizer(RATES, BETA2)
        self.kept = None if self.splats.frozen is None else self.splats.frozen.clone()
        self.steps, self.events = 0, 0
        self.rows = [self.row_of(i) for i in range(len(self.splats))]

    def row_of(self, i: int) -> Row:
        """Row i as the splats hold it, with moments of zero."""
        row = {name: value.detach()[i].clone() for name, value in self.splats.parameters.items()}
        row |= {name: self.splats.state[name][i].clone() for name in ("id", "tag", "update")}
        row |= {name: self.splats.state[name][i].clone() for name in self.generations.states}
        return row | {f"{k}_{name}": torch.zeros_like(row[name]) for name in PARAMETERS for k in ("m", "v")}

    def child(self, row: Row, **own: torch.Tensor) -> Row:
        """What a child born now of `row` should be."""
        born = {**row, **own, "generation": torch.tensor(self.events + 1)}
        born |= {f"anchor_{name}": born[name] for name in PARAMETERS}
        return born | {f"{k}_{name}": torch.zeros_like(row[name]) for name in PARAMETERS for k in ("m", "v")}

    # --- operations, each on both

    def step(self, g: torch.Generator) -> None:
        for value in self.splats.parameters.values():
            value.grad = torch.randn(value.shape, generator=g)
        self.steps += 1
        for i, row in enumerate(self.rows):
            for name in PARAMETERS:
                grad = self.splats.parameters[name].grad[i]
                row[f"m_{name}"] = BETA1 * row[f"m_{name}"] + (1 - BETA1) * grad
                row[f"v_{name}"] = BETA2 * row[f"v_{name}"] + (1 - BETA2) * grad.square()
                m = row[f"m_{name}"] / (1 - BETA1**self.steps)
                v = row[f"v_{name}"] / (1 - BETA2**self.steps)
                row[name] = row[name] - row["update"] * RATE * m / (v.sqrt() + 1e-15)
        with self.splats.scaled_update():
            self.splats.optimizer.step()
        self.splats.optimizer.zero_grad()

    def feather(self, g: torch.Generator) -> None:
        share = feathered(len(self.rows), g)
        self.splats.state["update"] = share
        for row, value in zip(self.rows, share, strict=True):
            row["update"] = value.clone()

    def reset(self, g: torch.Generator) -> None:
        reset_opacity(self.splats)
        for row in self.rows:
            row["logit_opacities"] = row["logit_opacities"].clamp(max=math.log(0.01 / 0.99))
            row["m_logit_opacities"] = row["v_logit_opacities"] = torch.zeros(())

    def append(self, g: torch.Generator) -> None:
        parents = (torch.rand(len(self.rows), generator=g) < 0.4).nonzero()[:, 0]
        changed = {"quats": torch.randn(len(parents), 4, generator=g)}
        changed |= self.generations.newborn(self.splats, parents, changed)
        self.splats.rearrange(torch.arange(len(self.rows)), parents, changed)
        quats = changed["quats"]
        self.rows += [self.child(self.rows[i], quats=q) for i, q in zip(parents.tolist(), quats, strict=True)]

    def remove(self, g: torch.Generator) -> None:
        keep = torch.randperm(len(self.rows), generator=g)[: max(1, round(0.8 * len(self.rows)))]  # rows move, too
        self.splats.rearrange(keep, keep[:0], {})
        self.rows = [self.rows[i] for i in keep.tolist()]

    def densify(self, g: torch.Generator) -> None:
        chosen, scales = torch.rand(len(self.rows), generator=g) < 0.5, self.splats.edited.scales.detach().amax(-1)
        opacities = self.splats.edited.opacities.detach()
        self.splats.state |= dict(grad_sum=chosen.float(), grad_count=torch.ones(len(self.rows)))
        faint = float(torch.rand(1, generator=g)) / 3
        config = DensifyConfig(grad_threshold=0.5, dense_size=1.0, max_size=0, min_opacity=faint)
        survivors, clones, halves = [], [], []
        for i, row in enumerate(self.rows):
            if opacities[i] < faint:
                continue
            split = chosen[i] and scales[i] > 1
            if not split:
                survivors.append(row)
            if chosen[i]:
                (halves if split else clones).append(row)
        if self.kept is None and not survivors + clones + halves:
            with pytest.raises(SceneError, match="every splat"):
                densify(self.splats, config, 1.0, g, self.generations)
            return
        densify(self.splats, config, 1.0, g, self.generations)
        drawn = self.splats.parameters["means"].detach().clone()[len(survivors) + len(clones) :]  # at random
        halved = [
            self.child(row, means=mean, log_scales=row["log_scales"] - math.log(1.6))
            for row, mean in zip(halves * 2, drawn, strict=True)
        ]
        self.rows = survivors + [self.child(row) for row in clones] + halved
        self.events += 1
        if self.generations.anchor == "last-densify":
            self.rows = [{**row, **{f"anchor_{name}": row[name] for name in PARAMETERS}} for row in self.rows]

    def checkpoint(self, g: torch.Generator) -> None:
        parts = [self.splats, self.splats.optimizer, self.generations]
        file = io.BytesIO()
        torch.save([part.state_dict() for part in parts], file)
        file.seek(0)
        splats, optimizer, generations = torch.load(file)
        self.splats = Splats.from_state_dict(splats, torch.device("cpu"))
        self.splats.make_optimizer(RATES, BETA2).load_state_dict(optimizer)
        self.generations = Generations(0.05, 0.1, 1.3, 10, anchor=self.generations.anchor)
        self.generations.load_state_dict(generations, self.splats)

    # --- what must hold after each

    def check(self) -> None:
        splats = self.splats
        assert len(splats) == len(self.rows) and len(self.generations) == self.events + 1
        assert all(len(value) == len(self.rows) for value in splats.state.values())
        held = {**{name: value.detach() for name, value in splats.parameters.items()}, **splats.state}
        for name, value in splats.parameters.items():
            moments = splats.optimizer.state.get(value)
            held |= {f"m_{name}": moments["exp_avg"], f"v_{name}": moments["exp_avg_sq"]} if moments else {}
        for name, value in held.items():
            if self.rows and name in self.rows[0]:
                expected = torch.stack([row[name] for row in self.rows])
                exact = name in ("id", "tag", "generation", "update")
                tolerance = dict(rtol=0, atol=0) if exact else dict(rtol=1e-4, atol=1e-5)
                torch.testing.assert_close(value, expected, **tolerance, msg=lambda m, name=name: f"{name}: {m}")
        if self.kept is None:
            assert splats.frozen is None
            return
        for name, value in [*self.kept.parameters(), *self.kept.extra.items()]:
            now = getattr(splats.frozen, name) if name in PARAMETERS else splats.frozen.extra[name]
            assert torch.equal(now, value), name
            whole = getattr(splats.scene, name) if name in PARAMETERS else splats.scene.extra[name]
            assert torch.equal(whole[: len(value)], value), name


@given(
    st.integers(1, 7),
    st.sampled_from([0, 0, 3]),
    st.sampled_from([0, 1]),
    st.sampled_from(ANCHORS),
    st.lists(st.tuples(st.sampled_from(OPERATIONS), st.integers(0, 10_000)), min_size=1, max_size=12),
)
@settings(max_examples=80, deadline=None, derandomize=True)
def test_all_that_belongs_to_a_row_stays_with_it(editable, frozen, sh_degree, anchor, operations):
    twin = Twin(editable + frozen, frozen, sh_degree, anchor)
    for operation, seed in operations:
        if twin.rows or operation in ("step", "checkpoint", "densify", "reset"):
            getattr(twin, operation)(torch.Generator().manual_seed(seed))
            twin.check()
