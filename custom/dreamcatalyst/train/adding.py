"""Things put into scenes, as methods: alone, and with an edit of the thing where it stands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .. import plugin
from ..data.views import view_number
from ..demo.capture import PREFIX
from ..demo.worlds import make_world
from ..errors import ConfigError, PriorError
from ..report.pictures import picture_row, write_png
from ..report.run import Panels
from ..scene.gaussians import Gaussians
from ..scene.trainable import Splats
from .add_config import AddParts
from .editing import EditMethod
from .placing import Added, Adder, Thing, read_thing
from .plan import PlanBuilder, scene_bytes
from .sourced import SourcedMethod


class Addition:
    """What both methods have: a thing that is read early, and put into the scene that is given."""

    def read(self: Any) -> Thing:
        """The thing, read at the first call."""
        if not hasattr(self, "_thing"):
            config, data = self.part.add, self.context.data
            origin = None if config.stands else self.origin
            self._thing = read_thing(config, data.cfg.orbit_up, self.cfg.seed, self.cfg.drop_nonfinite, origin)
        return self._thing

    def put_in(self: Any, scene: Gaussians) -> Added:
        """`scene` with the thing in it."""
        config, data = self.part.add, self.context.data
        capture = data.open(scene, self.cfg.gs_source)
        source = str(data.cfg.source or "")
        made = source.startswith(PREFIX) and not self.cfg.gs_source
        host = make_world(source.removeprefix(PREFIX)) if made else None
        added = Adder(config, self.read(), capture, self.draw, self.origin)(scene.to(self.context.device), host)
        there = [round(a + b, 4) for a, b in zip(added.foot, self.origin, strict=True)]
        self.told = (
            f"{added.count:,} splats of {config.path}, {added.height:.3g} high, its foot at {there}; colours times "
            f"{', '.join(f'{v:.2f}' for v in added.gain)} (RGB, {config.light})"
        )
        plugin.info(f"put in: {self.told}")
        return added


class AddMethod(Addition, SourcedMethod):
    """Puts a thing into the scene, and that is all: there is no step to take. added: with what came of it."""

    part: AddParts
    added: Added
    told = ""

    @property
    def title(self) -> str:
        return f"{Path(self.part.add.path).name} put in"

    def prepare(self) -> None:
        super().prepare()
        if self.told:
            return
        self.read()
        self.load_source()
        self.added = self.put_in(self.source.scene)
        self.truth = self.added.truth

    def first_scene(self) -> Gaussians:
        return self.added.scene

    def make_splats(self, scene: Gaussians) -> Splats:
        self.begin_at(scene, self.added.rows, is_source=False)
        return Splats(scene)

    def panels(self, index: int) -> Panels:
        references = self.references(index)
        shown = [("before", references["source"]), ("with it", self.picture(index))]
        return [*shown, *([("the truth", references["truth"])] if "truth" in references else [])]

    def video_frame(self, cameras: Any) -> Panels:
        before, after = self.draw(self.source.scene, cameras), self.draw_now(cameras)
        return [("before", before.rgb[0]), ("with it", after.rgb[0])]

    def describe(self, plan: PlanBuilder) -> None:
        plan.add("put in", self.told, scene_bytes(self.added.scene[self.added.rows]))
        plan.leave_out("training", "prompt_processor.prompt is empty: nothing is asked of the thing")

    def preview(self) -> list[Path]:
        """Write one view with the thing: that of its pixel, or the first that is held out."""
        self.begin()
        view, names = self.part.add.view, [v.name for v in self.capture.views]
        number = self.context.data.held_out[0] if view is None else view_number(view, names, "system.add.view")
        return [write_png(self.context.save("preview.png"), picture_row(self.panels(number)))]


class AddedEditMethod(Addition, EditMethod):
    """Puts a thing into the scene and edits it there. The source, as the prior sees it, has the thing in it."""

    part: AddParts
    told = ""

    def load_prior(self) -> None:
        super().load_prior()
        if self.guidance.prior.takes_truth:
            raise PriorError(
                "system.guidance.prior_type: got one that knows the truth of a synthetic scene, which has no such "
                "thing in it. Choose another prior, or leave the prompt empty."
            )

    def _find_truth(self) -> None:
        """What a world becomes by an edit is known without the thing."""

    def scene_before(self) -> Gaussians:
        if self.cfg.original:
            raise ConfigError(
                f"system.original: got '{self.cfg.original}', expected none: the source of this edit is the scene with "
                "the thing in it."
            )
        self.read()
        self.alone = self.given_scene()
        return self.put_in(self.alone).scene

    def scene_to_keep(self) -> Gaussians:
        return self.alone

    def describe(self, plan: PlanBuilder) -> None:
        plan.add("put in", self.told)
        super().describe(plan)
