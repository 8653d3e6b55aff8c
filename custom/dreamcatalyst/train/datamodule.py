"""The data of a run: which views there are, and which of them each step takes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from torch.utils.data import DataLoader, IterableDataset

from .. import plugin
from ..config import AtLeastOne, Seed, parse
from ..data.formats import CaptureOptions
from ..data.inria import beside as cameras_beside
from ..data.loader import has_prefix, open_capture
from ..data.orbit import orbit_capture
from ..data.origin import ZERO, Origin
from ..data.sizes import DRAWN, require_memory
from ..data.views import Capture, views_for_step
from ..errors import ConfigError
from ..scene.formats.api import splat_origin
from ..scene.gaussians import Gaussians


class StepViews(IterableDataset):
    """Endless batches {"index": view numbers, "visit": how often each came before} from the trainer's step on, a
    function of the seed and the step."""

    def __init__(self, data: SplatData):
        self.data = data

    def __iter__(self) -> Iterator[dict[str, Any]]:
        train, batch, seed = self.data.capture.train, self.data.cfg.batch_size, self.data.cfg.seed
        for step in count(self.data.trainer.global_step):
            ahead = views_for_step(seed, step + 1, len(train), batch)
            self.data.capture.prefetch([train[i] for i in ahead])
            visits = [place // len(train) for place in range(step * batch, (step + 1) * batch)]
            yield {"index": [train[i] for i in views_for_step(seed, step, len(train), batch)], "visit": visits}


@plugin.register("dreamcatalyst-data")
class SplatData(plugin.pl.LightningDataModule):
    """Views of a capture in any format of data/formats.py, or around given splats."""

    @dataclass(frozen=True)
    class Config(CaptureOptions):
        source: str | None = None  # capture folder, or demo:<world>; empty: cameras beside or around the splats
        batch_size: AtLeastOne = 1  # views per step
        seed: Seed = 0  # of the order of the views

    cfg: Config

    def __init__(self, cfg: Any = None):
        super().__init__()
        self.cfg = parse(self.Config, cfg or {}, "data")
        self.capture: Capture | None = None
        self._origins: dict[str, Origin] = {}
        if self.cfg.source and has_prefix(self.cfg.source):  # no path but a name, which is known or not
            self.open()

    def open(self, scene: Gaussians | None = None, splats: str = "") -> Capture:
        """The capture, read at the first call. Where there is no source: the cameras that 3DGS wrote beside the file
        `splats`, or else an orbit around `scene`. Raises ConfigError where a step would take more
        views than there are."""
        if self.capture is not None:
            return self.capture
        if self.cfg.source:
            self.capture = open_capture(self.cfg.source, self.cfg)
        elif splats and (cameras := cameras_beside(Path(splats))) is not None:
            self.capture = open_capture(cameras, self.cfg)
        elif scene is not None:
            self.capture = orbit_capture(scene, self.cfg)
        else:
            raise ConfigError("data.source: nothing is given. Name a capture folder or demo:statue.")
        self._check_batch(self.capture)
        for notice in self.capture.notices:
            plugin.info(notice)
        return self.capture

    def _check_batch(self, capture: Capture) -> None:
        largest = max((view.camera for view in capture.views), key=lambda c: c.width * c.height)
        require_memory(
            self.cfg.batch_size * largest.width * largest.height * DRAWN,
            f"data.batch_size={self.cfg.batch_size}: so many views of {largest.width}x{largest.height} pixels",
            "Set a smaller one",
        )
        sizes = {(c.width, c.height) for c in (capture.views[i].camera for i in capture.train)}
        if self.cfg.batch_size > 1 and len(sizes) > 1:
            found = ", ".join(f"{width}x{height}" for width, height in sorted(sizes)[:5])
            raise ConfigError(
                f"data.batch_size: got {self.cfg.batch_size}, expected 1: the views are of different sizes ({found}), "
                "which cannot be one batch. Or set data.width and data.height"
            )

    def origin(self, splats: str = "") -> Origin:
        """The point of the files' world that is (0,0,0) in this run, the same for cameras and splats: of the capture,
        or where there is none, of the file `splats`, which is read once."""
        if splats not in self._origins:
            self._origins[splats] = self._find_origin(splats)
        return self._origins[splats]

    def _find_origin(self, splats: str) -> Origin:
        if not (self.cfg.source or splats):
            return ZERO
        if self.cfg.source or cameras_beside(Path(splats)) is not None:
            return self.open(None, splats).origin
        return splat_origin(splats)

    @property
    def held_out(self) -> list[int]:
        """The views that are scored: those held out, or all training views where none is."""
        return self.capture.test or self.capture.train

    def train_dataloader(self) -> DataLoader:
        return DataLoader(StepViews(self), batch_size=None)

    def _each(self) -> DataLoader:
        views: Any = [{"index": [i]} for i in self.held_out]  # a list is a dataset
        return DataLoader(views, batch_size=None)

    def val_dataloader(self) -> DataLoader:
        return self._each()

    def test_dataloader(self) -> DataLoader:
        return self._each()

    def predict_dataloader(self) -> DataLoader:
        return self._each()
