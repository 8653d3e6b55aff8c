"""What `--export` writes: the splats in a format of one's choice, and what that format loses of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from ..config import Count, parse
from ..data.camera import Cameras
from ..data.origin import Origin
from ..errors import ConfigError
from ..report.metrics import psnr
from ..scene.fitted import Fitted
from ..scene.formats.api import SPLATS, SplatFormat, Written, named, read_splats, write_splats, writer
from ..scene.gaussians import Gaussians
from .drawing import Drawer

NAME = "point_cloud"  # of the file in the export's folder


@dataclass(frozen=True)
class ExportConfig:
    """The section `export` of a run."""

    format: str | None = field(default=None, metadata={"choices": SPLATS})  # None: as the path is named, else ply
    path: str | None = None  # the file to write; None: point_cloud.* in the trial's save/it<step>-export
    options: dict = field(default_factory=dict)  # of the format
    views: Count = 4  # views at which the renders of a lossy format are compared with those before; 0: none

    @property
    def _named(self) -> tuple[SplatFormat, str] | None:
        return None if self.path is None else named(self.path)

    @property
    def chosen(self) -> str:
        """The name of the format."""
        by_name = self._named
        if self.format is not None or by_name is None:
            return self.format or "ply"
        return next(name for name in SPLATS.names() if SPLATS.get(name) is by_name[0])

    @property
    def all_options(self) -> Mapping[str, Any]:
        """The options, with those that the file's name implies."""
        by_name = self._named
        return {**(by_name[0].implied.get(by_name[1], {}) if by_name else {}), **self.options}

    def stem(self, folder: Path) -> Path:
        """The file to write, without its suffix."""
        if self.path is None:
            return folder / NAME
        path, by_name = Path(self.path), self._named
        if by_name is None:
            return path
        kept = path.name[: -len(by_name[1])]
        return path.with_name(kept) if kept else path.parent  # meta.json stands for its folder


def read_export(section: Any) -> ExportConfig:
    """The section `export`, checked. Raises ConfigError."""
    config = parse(ExportConfig, section, "export")
    writer(config.chosen, config.all_options)
    path, given = config.path, config._named
    if path is not None and config.stem(Path()).name in ("", ".", ".."):
        raise ConfigError(f"export.path: '{path}' names no file, expected one such as splats.spz.")
    if given is not None and config.format is not None and given[0] is not SPLATS.get(config.format):
        raise ConfigError(f"export.path: '{path}' is the name of a {given[0].title}; export.format is {config.format}.")
    return config


def export(
    config: ExportConfig,
    folder: Path,
    scene: Gaussians,
    origin: Origin,
    fitted: Fitted | None,
    draw: Drawer,
    cameras: Sequence[Cameras],
    say: Callable[[str], None],
) -> Path:
    """Write the splats, and say what the file lacks: what was left out, and for a format that loses something, how far
    the splats and their renders at `cameras` differ when they are read again. Returns the file's path."""
    comments = [] if fitted is None else [fitted.comment]
    stem, options = config.stem(folder), config.all_options
    written = write_splats(stem, scene, config.chosen, options=options, origin=origin, comments=comments)
    kind = SPLATS.get(config.chosen)
    if written.left_out:
        say(f"a {kind.title} does not hold {' and '.join(written.left_out)}")
    if kind.loses and config.views:
        say(f"{kind.title}: {kind.loses}. {loss_of(written, origin, draw, cameras)}")
    say(f"exported to {written.path}")
    return written.path


@torch.no_grad()
def loss_of(written: Written, origin: Origin, draw: Drawer, cameras: Sequence[Cameras]) -> str:
    """How far a file differs from what it was written of, in words."""
    before = written.scene
    after = read_splats(written.path, origin=origin, quiet=True)
    device = cameras[0].viewmats.device if cameras else torch.device("cpu")
    shown = [draw(scene.to(device), camera).rgb for camera in cameras for scene in (before, after)]
    values = [float(psnr(a.clamp(0, 1), b.clamp(0, 1))) for a, b in zip(shown[::2], shown[1::2], strict=True)]
    renders = f"PSNR of renders before and after: {min(values):.1f} to {max(values):.1f} dB at {len(values)} views"
    position = float((before.means - after.means).abs().max())
    scale = float((before.log_scales - after.log_scales).abs().max().expm1())
    opacity = float((before.opacities - after.opacities).abs().max())
    return f"{renders}; positions to {position:.2g}, scales to {100 * scale:.2g} %, opacities to {opacity:.2g}"
