"""Scores, pictures and exports of a method, as Lightning asks for them: validate, test and predict."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .. import plugin
from ..report.clip import ClipJudge
from ..report.pictures import picture_row, write_png
from ..report.record import Record
from ..report.results import write_results, write_video_along
from ..report.run import RunFacts
from ..report.scores import mean_scores, print_scores
from .base import System
from .export import ExportConfig, export
from .method import Method, MethodParts
from .result import ResultFiles


class MeasuredSystem(System):
    """A system whose method is looked at. Method: what is run."""

    Method: type[Method] = Method
    Parts = MethodParts
    part: MethodParts
    exported_as = ExportConfig()  # what --export writes; set by the launcher

    def configure(self) -> None:
        super().configure()
        self.record, self.plan_text = Record(self.part.report), ""
        self.method = self.Method(self.cfg, self.part, self.record.clock)
        self.files = ResultFiles(self.save_path)
        self.judge: ClipJudge | None = None
        self._scores: dict[int, dict[str, float]] = {}

    def save_path(self, name: str) -> Path:
        """A file under the run's save folder."""
        return Path(self.get_save_path(name))

    @property
    def report_dir(self) -> Path:
        """The run's report folder, beside save/."""
        return Path(self.get_save_dir()).parent / "report"

    def write_splats(self, name: str) -> Path:
        """Write the splats of the moment as a 3DGS PLY under the save folder."""
        return self.files.write(name, self.method.splats.scene, self.method.origin, self.method.fitted)

    def facts(self) -> RunFacts:
        """What reports may know of this moment."""
        method, context = self.method, self.method.context
        return RunFacts(
            title=method.title,
            config=self.part.report,
            settings=self.cfg,
            folder=self.report_dir.parent,
            save=self.save_path,
            device=context.device,
            capture=method.capture,
            held_out=context.data.held_out,
            step=self.true_global_step,
            splats=method.splats.total,
            plan=self.plan_text,
            scenes=lambda: {"": method.splats.scene.detach(), **method.known_scenes()},
            draw=method.draw,
            picture=method.picture,
            references=method.references,
            region=method.region,
            panels=method.panels,
            frame=method.video_frame,
            judge=self.judge,
            counts=method.counts,
        )

    def validation_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        self._look(batch, "-")

    def test_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        self._look(batch, "-test/")

    def _look(self, batch: Mapping[str, Any], folder: str) -> None:
        """Score the views of a batch, and write their pictures under "it<step><folder>"."""
        facts = self.facts()
        for index in batch["index"]:
            self._scores[index] = facts.score(index)
            write_png(self.save_path(f"it{facts.step}{folder}{index}.png"), picture_row(facts.panels(index)))

    def on_validation_epoch_end(self) -> None:
        print_scores(self._scores, self.method.capture)
        self._log(mean_scores(list(self._scores.values())), "val")

    def on_test_epoch_end(self) -> None:
        facts = self.facts()
        splats = self.files.keep_tested(facts.step, self.write_splats)  # first what would be missed most
        self._log(write_results(facts, self.record, self._scores, splats), "test")
        plugin.info(f"{facts.splats} splats after {facts.step} steps, {self.record.clock.seconds:.1f} s")

    def _log(self, mean: Mapping[str, float], stage: str) -> None:
        """Hand mean scores to Lightning's loggers, and begin anew."""
        self.log_dict({f"{stage}/{name}": value for name, value in mean.items()})
        self._scores = {}

    def predict_step(self, batch: Mapping[str, Any], batch_idx: int) -> None:
        """Export needs no view of its own."""

    def on_predict_epoch_end(self) -> None:
        method, held_out = self.method, self.method.context.data.held_out
        folder, views = Path(self.get_save_dir()) / f"it{self.true_global_step}-export", self.exported_as.views
        cameras = [method.camera(index) for index in held_out[:: max(1, len(held_out) // max(views, 1))][:views]]
        scene, fitted = method.splats.scene.detach(), method.fitted
        export(self.exported_as, folder, scene, method.origin, fitted, method.draw, cameras, plugin.info)
        video = write_video_along(self.facts(), folder / "video.mp4")
        if video is not None:
            plugin.info(f"exported to {video}")
