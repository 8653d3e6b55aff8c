"""What every system here does before it builds anything: a config checked whole, and what cannot be done refused."""

from __future__ import annotations

from typing import Any, get_type_hints

from .. import plugin
from ..config import check, parse
from ..errors import ConfigError


class System(plugin.BaseSystem):
    """Base of all registered systems. Parts: the sections of Config that are free dicts, each with its dataclass; they
    are in `self.part`, parsed, when `configure` returns."""

    Parts: type[Any] = object  # a dataclass: name of a section to its own dataclass
    takes_steps = True  # whether there is something to train; else a run is a test
    parts: dict[str, type] = {}  # the same by name, for config.check
    part: Any

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.parts = get_type_hints(cls.Parts)

    def __init__(self, cfg: Any, resumed: bool = False):
        # The host's own parser knows neither the nearest key nor what the free sections may hold.
        check(type(self), cfg, "system")
        super().__init__(cfg, resumed)

    def configure(self) -> None:
        if self.cfg.weights is not None:
            raise ConfigError(
                f"system.weights: got '{self.cfg.weights}', but {type(self).__name__} has no weights until it runs. "
                "To go on with that run: resume=<its checkpoint>. To begin from its splats: "
                "system.gs_source=<its folder>/save/last.ply"
            )
        self.automatic_optimization = False
        self.part = self.Parts(
            **{name: parse(cls, getattr(self.cfg, name), f"system.{name}") for name, cls in self.parts.items()}
        )

    def configure_callbacks(self) -> list:
        """No callbacks: the first thing that Lightning asks for in every process, before data or model are touched, and
        so the place to refuse several of them."""
        if self.trainer.world_size > 1:
            raise ConfigError(
                f"trainer: asks for {self.trainer.world_size} processes, and {type(self).__name__} runs in one. Set "
                "trainer.devices=1, or let only one GPU be seen: --gpu 0, or CUDA_VISIBLE_DEVICES=0."
            )
        return []
