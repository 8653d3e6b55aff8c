"""A thing put in by one command: the system that a YAML names, and its sections."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from .. import plugin
from ..errors import ConfigError
from .add_config import AddParts
from .adding import AddedEditMethod, AddMethod
from .edit import EditSystem
from .plan import PlanBuilder


@plugin.register("dreamcatalyst-add-system")
class AddSystem(EditSystem):
    """Puts a thing into the splats of gs_source (or those that the capture carries), and edits it there where there is
    a prompt. Without one no step is taken."""

    Parts = AddParts

    @dataclass
    class Config(EditSystem.Config):
        add: dict = field(default_factory=dict)  # what is put in, and where

    method: Any

    def configure(self) -> None:
        self.takes_steps = bool(str(self.cfg.prompt_processor.get("prompt") or "").strip())
        self.Method = AddedEditMethod if self.takes_steps else AddMethod
        super().configure()

    def look_ahead(self, data: Any) -> None:
        self.enter(data, self.device)
        self.method.read()
        if self.takes_steps:
            self.method.load_prior()

    def setup(self, stage: str) -> None:
        if stage == "fit" and not self.takes_steps:
            raise ConfigError(
                "system.prompt_processor.prompt: is empty, so that there is nothing to train. Test instead: the thing "
                "is put in then"
            )
        super().setup(stage)
        if not self.takes_steps:
            plan = PlanBuilder()
            self.method.describe(plan)
            done = plan.finish(0)
            done.write(self.report_dir / "plan.json")
            self.plan_text = done.text()
            self.method.begin_training()
