"""Splats on the way: the fit with which an edit of photographs begins where it is given none, kept for the next one.

It is a run of configs/fit.yaml at the size at which the edit draws; the launcher carries it out as any other.
"""

from __future__ import annotations

import fnmatch
import json
import shutil
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from .. import kept, plugin
from ..config import ExperimentConfig, check, merge_config, read_config
from ..config.merge import escaped
from ..data.loader import has_prefix
from ..data.views import Capture, View
from ..errors import ConfigError
from ..files import file_digest, write_text
from ..report.summary import FIT
from ..resume import MAY_CHANGE, contents, read_checkpoint, recipe
from ..scene.fitted import downscale_for
from .datamodule import SplatData
from .edit_config import FirstFitConfig
from .result import RESULT

VERSION = 1  # of what a fit makes by the same recipe; where it is another one, fits are made anew
OWN = ("source", "max_view_num", "batch_size", "seed", "width", "height", "max_side", "downscale")  # not the edit's
WHERE_IT_RUNS = ("accelerator", "devices", "enable_progress_bar")  # of the trainer: as the edit has it


@dataclass(frozen=True)
class FirstFit:
    """A fit to the photographs of `data`. merged: its config, of `steps` steps, whose run has the folder `folder`."""

    data: SplatData
    steps: int
    merged: DictConfig
    folder: Path

    @classmethod
    def of(cls, config: ExperimentConfig, parts: Mapping[str, type], base: str | Path) -> FirstFit | None:
        """The fit that a run needs; None where it needs none, or there is nothing to fit to.

        config, parts: of the run, and its classes of data and system. base: the YAML of fits. Raises ConfigError, and
        DataError for the capture.
        """
        wanted = check(parts["system"], config.system, "system").get("first_fit")
        if not isinstance(wanted, FirstFitConfig) or not wanted.steps or not issubclass(parts["data"], SplatData):
            return None
        source, given = config.data.get("source"), config.system.get("gs_source") or config.system.get("original")
        if given or not source or has_prefix(source):
            return None
        data = parts["data"](config.data)
        capture = data.open()
        begins = capture.points is not None or wanted.system.get("mesh") or wanted.system.get("gs_source")
        if capture.scene is not None or not capture.has_photos or not begins:
            return None
        try:
            merged = merge_config(base, **_overrides(config, wanted, capture))
            fit = read_config(merged)
            told = recipe(fit, {"data": parts["data"], "system": plugin.find(fit.system_type)})
        except ConfigError as error:
            raise ConfigError(f"system.first_fit: {error}") from error
        del told["data.source"]  # its content counts, wherever it lies
        merged.tag = name = kept.digest(VERSION, _content(capture), _what_counts(told), contents(told))
        return cls(data, wanted.steps, merged, kept.home() / "fits" / name)

    @property
    def source(self) -> Path:
        """The capture."""
        return self.data.open().source

    @property
    def result(self) -> Path:
        """The PLY of its splats."""
        return self.folder / "save" / RESULT

    @property
    def told(self) -> dict[str, Any]:
        """How it went, by what it left; empty where it has not come to its end, or its splats have changed since."""
        path = self.folder / FIT
        told: dict[str, Any] = {}
        try:
            told = json.loads(path.read_text(encoding="utf-8"))
            whole = told["digest"] == file_digest(self.result)
        except FileNotFoundError:
            return {}
        except (ValueError, TypeError, KeyError):
            whole = False
        if not whole:
            plugin.warn(f"{self.folder}: what is kept of the fit is damaged, so it is fitted again")
            path.unlink()
            return {}
        return told

    @property
    def checkpoint(self) -> Path:
        """Where an interrupted one left off."""
        return self.folder / "ckpts" / "last.ckpt"

    def begin(self) -> int:
        """The step from which it goes on, 0 for a new one. What cannot be gone on from is taken away, and said."""
        if self.checkpoint.is_file():
            try:
                step = read_checkpoint(self.checkpoint, to_train=True)["global_step"]
            except ConfigError as error:
                plugin.warn(f"{error} It is fitted anew")
            else:
                self.merged.resume = str(self.checkpoint)
                return step
        if self.folder.is_dir():
            shutil.rmtree(self.folder)
        return 0

    def finish(self) -> None:
        """Write down how it went, and let go of what only training needs."""
        summary = json.loads((self.folder / "report" / "summary.json").read_text(encoding="utf-8"))
        told = {"steps": self.steps, "seconds": summary["seconds"], "splats": summary["splats"], **summary["mean"]}
        told["digest"] = file_digest(self.result)
        write_text(self.folder / FIT, json.dumps({"source": str(self.source), **told}, indent=2) + "\n")
        shutil.rmtree(self.folder / "ckpts", ignore_errors=True)

    def text(self, told: Mapping[str, Any]) -> str:
        """How it went, in words."""
        psnr = told.get("psnr_photo_inside", told.get("psnr_photo"))
        score = "" if psnr is None else f", {psnr:.2f} dB at held-out views"
        what = f"{told['splats']:,} splats after {told['steps']:,} steps in {told['seconds']:,.0f} s{score}"
        return f"splats fitted to the photographs of {self.source}: {what}; kept in {self.folder}"


def _overrides(config: ExperimentConfig, wanted: FirstFitConfig, capture: Capture) -> dict[str, Any]:
    """What a fit for the edit `config` has otherwise than its YAML."""
    data, renderer, trainer = (plain(node) for node in (config.data, config.system.get("renderer"), config.trainer))
    options = capture.options
    if options.width is None and options.height is None:
        size = {"max_side": options.max_side, "downscale": options.downscale}
    else:  # the edit sees a window of each photograph; a fit sees all of it, as finely
        size = {"max_side": None, "downscale": downscale_for([capture.views[i] for i in capture.train])}
    given = {
        "name": "fits",
        "tag": "fit",
        "use_timestamp": False,
        "exp_root_dir": str(kept.home()),
        "data_type": config.data_type,
        "data": {**{key: value for key, value in data.items() if key not in OWN}, "source": data["source"], **size},
        "system": {"renderer": renderer, "report": {"video_frames": 0}},
        "trainer": {"max_steps": wanted.steps, **{key: trainer[key] for key in WHERE_IT_RUNS if key in trainer}},
    }
    told = OmegaConf.merge(
        escaped(given), {"data": escaped(plain(wanted.data)), "system": escaped(plain(wanted.system))}
    )
    return {str(key): value for key, value in told.items()}


def plain(node: Any) -> dict[str, Any]:
    """A section as a dict."""
    return cast(dict[str, Any], OmegaConf.to_container(node)) if OmegaConf.is_config(node) else dict(node or {})


def _what_counts(told: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a recipe that say what a fit becomes, wherever it runs."""
    free = [key for key in told for pattern in MAY_CHANGE if fnmatch.fnmatchcase(key, pattern)]
    return {key: value for key, value in told.items() if key == "trainer.max_steps" or key not in free}


def _content(capture: Capture) -> list[Any]:
    """What a capture shows: its cameras at the size in which they are used, its points, and all bytes of its
    photographs."""

    def of(view: View) -> list[Any]:
        camera, photo = view.camera, view.photo
        files = [] if photo is None else [file_digest(path) for path in (photo.path, photo.mask) if path is not None]
        seen = [] if photo is None else [photo.lens, photo.window, photo.mask is None, *files]
        return [view.name, camera.viewmats, camera.Ks, camera.width, camera.height, seen]

    with ThreadPoolExecutor() as pool:
        views = list(pool.map(of, capture.views))
    return [views, capture.points, capture.origin]
