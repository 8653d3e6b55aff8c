"""Splats that are being optimised: parameters, their Adam moments and every other per-splat tensor, always in step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Bool, Int, Shaped
from torch import Tensor

from ..errors import SceneError
from .gaussians import PARAMETERS, Gaussians

UPDATE = "update"  # the state in (0,1] that says how much of each update a row takes


class Splats:
    """The trainable form of a scene of N splats, of which E are editable.

    editable: bool [N], default all. The rows of this class, `len`, `parameters`, their Adam moments and `state` are
    those E alone, in the scene's order; the others cost no gradient, no moment and no state.
    parameters: the six raw parameters as leaves with gradients. state: further per-splat tensors [E,...] by name
    (statistics, generations, anchors, "update"). `rearrange` is the only place where rows come, go or move.
    frozen: the other N - E splats, None where there are none; their tensors are never written to.
    Raises SceneError where `editable` or a state disagrees with the scene, or "update" leaves (0,1].
    """

    def __init__(
        self, scene: Gaussians, state: Mapping[str, Tensor] | None = None, editable: Bool[Tensor, " N"] | None = None
    ) -> None:
        self.frozen: Gaussians | None = None
        if editable is not None:
            scene, self.frozen = _divide(scene, editable)
        self.parameters = {name: torch.nn.Parameter(value.detach().clone()) for name, value in scene.parameters()}
        self.state: dict[str, Tensor] = {**scene.extra, **(state or {})}
        self._extras = tuple(scene.extra)
        self.optimizer: torch.optim.Optimizer | None = None
        for name, value in self.state.items():
            if value.shape[:1] != (len(self),):
                raise SceneError(f"splats: state '{name}' has {tuple(value.shape)}, expected {len(self)} rows")
        share = self.state.get(UPDATE)
        if share is not None and not bool(((share > 0) & (share <= 1)).all()):
            raise SceneError("splats: state 'update' leaves (0,1]; rows that take nothing of it are not editable")

    def __len__(self) -> int:
        """Number of editable splats: the rows that move."""
        return self.parameters["means"].shape[0]

    @property
    def total(self) -> int:
        """Number of all splats, frozen ones too."""
        return len(self) + (0 if self.frozen is None else len(self.frozen))

    @property
    def edited(self) -> Gaussians:
        """The editable splats as they are now, sharing memory and graph with the parameters."""
        return Gaussians(**self.parameters, extra={name: self.state[name] for name in self._extras})

    @property
    def scene(self) -> Gaussians:
        """All splats as they are now, frozen ones first, sharing the graph with the parameters (and their memory, too,
        where nothing is frozen; else this is a copy of the scene, so ask for it once a step)."""
        return self.edited if self.frozen is None else Gaussians.cat([self.frozen, self.edited])

    def make_optimizer(self, learning_rates: Mapping[str, float], beta2: float = 0.999) -> torch.optim.Optimizer:
        """Adam (beta1 0.9, eps as in 3DGS) with one group per parameter, group["name"] saying which."""
        groups = [{"params": [self.parameters[n]], "lr": learning_rates[n], "name": n} for n in PARAMETERS]
        self.optimizer = torch.optim.Adam(groups, betas=(0.9, beta2), eps=1e-15, fused=True)
        return self.optimizer

    @contextmanager
    def scaled_update(self) -> Iterator[None]:
        """Around the optimizer's step: rows whose state "update" is below 1 take only that share of it, in every
        parameter. Scaling their gradients instead would do nothing, since Adam divides by the gradient's own size.
        Free where there is no such state or all of it is 1."""
        share = self.state.get(UPDATE)
        rows = None if share is None else (share < 1).nonzero()[:, 0]
        if rows is None or len(rows) == 0:
            yield
            return
        before = {name: value.detach()[rows] for name, value in self.parameters.items()}
        yield
        with torch.no_grad():
            for name, value in self.parameters.items():
                weight = share[rows].to(value).reshape(-1, *[1] * (value.ndim - 1))
                value[rows] = torch.lerp(before[name], value[rows], weight)

    @torch.no_grad()
    def rearrange(
        self, keep: Int[Tensor, " K"], parents: Int[Tensor, " M"], changed: Mapping[str, Shaped[Tensor, "M ..."]]
    ) -> None:
        """Make the rows `keep` followed by one child for each of `parents`, everywhere at once.

        keep [K] and parents [M]: indices into the present (editable) rows. A child copies every parameter and state of
        its parent except those in `changed` (name to [M,...]). Survivors keep their Adam moments, children start at
        zero. Frozen rows stay.
        """
        known = (*PARAMETERS, *self.state)
        for name, value in changed.items():
            if name not in known:
                raise SceneError(f"rearrange: '{name}' is no per-splat tensor. Known: {', '.join(known)}.")
            if len(value) != len(parents):
                raise SceneError(f"rearrange: '{name}' has {len(value)} rows for {len(parents)} children")

        def rows(name: str, old: Tensor) -> Tensor:
            return torch.cat([old[keep], changed[name] if name in changed else old[parents]])

        self.state = {name: rows(name, old) for name, old in self.state.items()}
        groups = {g["name"]: g for g in self.optimizer.param_groups} if self.optimizer else {}
        for name, old in self.parameters.items():
            new = torch.nn.Parameter(rows(name, old.detach()))
            self.parameters[name] = new
            if not groups:
                continue
            moments = self.optimizer.state.pop(old, None)
            groups[name]["params"] = [new]
            if moments:
                self.optimizer.state[new] = {
                    key: torch.cat([value[keep], value.new_zeros(len(parents), *value.shape[1:])])
                    if value.shape == old.shape
                    else value
                    for key, value in moments.items()
                }

    def state_dict(self) -> dict[str, Any]:
        """Plain tensors for a checkpoint; the optimizer's own state is saved by the trainer."""
        return {
            "parameters": {name: value.detach() for name, value in self.parameters.items()},
            "state": dict(self.state),
            "extras": list(self._extras),
            "frozen": None if self.frozen is None else {**dict(self.frozen.parameters()), "extra": self.frozen.extra},
        }

    @staticmethod
    def from_state_dict(saved: Mapping[str, Any], device: torch.device) -> Splats:
        """The inverse of `state_dict`. Raises SceneError for a checkpoint that holds no splats."""
        if not {"parameters", "state", "extras"} <= set(saved):
            raise SceneError(f"checkpoint: no splats in it (found {sorted(saved)}); was it made by this extension?")
        state = {name: value.to(device) for name, value in saved["state"].items()}
        extra = {name: state.pop(name) for name in saved["extras"]}
        splats = Splats(Gaussians(**saved["parameters"]).to(device).with_extra(**extra), state)
        if saved.get("frozen") is not None:  # checkpoints made before there were masks do not mention it
            splats.frozen = Gaussians(**saved["frozen"]).to(device)
        return splats


def _divide(scene: Gaussians, editable: Bool[Tensor, " N"]) -> tuple[Gaussians, Gaussians | None]:
    """The editable part of a scene, and a plain copy of the rest, None where nothing is left of it."""
    if editable.dtype != torch.bool or editable.shape != (len(scene),):
        got = f"{editable.dtype} {tuple(editable.shape)}"
        raise SceneError(f"splats: editable is {got}, expected torch.bool ({len(scene)},), one for each splat")
    editable = editable.to(scene.means.device)
    if bool(editable.all()):
        return scene, None
    return scene[editable], scene[~editable].detach().map(torch.Tensor.contiguous)
