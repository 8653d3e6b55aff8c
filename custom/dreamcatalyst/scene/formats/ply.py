"""3DGS's own PLY (Kerbl et al. 2023): every number as it is, extras and comments too."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ...data.origin import Origin
from ..gaussians import Gaussians
from ..ply import read_rows, write_ply
from ..plyfile import read_comments
from .api import Found, NoOptions, SplatFormat, with_suffix


def detect(path: Path, head: bytes) -> bool:
    return head.startswith((b"ply\n", b"ply\r")) and b"packed_" not in head


def read(path: Path, origin: Origin) -> Found:
    return Found(read_rows(path, origin))


def write(stem: Path, scene: Gaussians, origin: Origin, comments: Sequence[str], options: NoOptions) -> Path:
    return write_ply(with_suffix(stem, ".ply"), scene, origin=origin, comments=comments)


FORMAT = SplatFormat("3DGS PLY", (".ply",), detect, read, write, extras=True, comments=read_comments)
