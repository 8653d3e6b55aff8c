"""Annotations of shapes are true: tests check them, and runs do not pay for it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import jaxtyping
import pytest
import torch
from dreamcatalyst.data.camera import look_at
from dreamcatalyst.loss.image import ssim_map

from tests import shapes

ROOT = Path(__file__).resolve().parent.parent


def test_a_wrong_shape_is_caught_where_it_is_handed_over():
    with pytest.raises(jaxtyping.TypeCheckError, match="ssim_map"):
        ssim_map(torch.zeros(1, 16, 16, 3), torch.zeros(1, 16, 8, 3))
    with pytest.raises(jaxtyping.TypeCheckError, match="up"):
        look_at(torch.zeros(2, 3), torch.ones(3), torch.ones(2, 3))


def test_all_but_kernels_is_checked():
    folders = [ROOT / "custom" / "dreamcatalyst" / name for name in shapes.FOLDERS]
    paths = [path.relative_to(ROOT / "custom") for folder in folders for path in folder.rglob("*.py")]
    files = {".".join(path.with_suffix("").parts) for path in paths}
    left_out = {name for name in files - set(shapes.checked_modules()) if not name.endswith("__init__")}
    assert all(name.startswith("dreamcatalyst.render.cpu") for name in left_out)
    assert "dreamcatalyst.render.api" in shapes.checked_modules()


def test_runs_check_nothing():
    code = (
        "import sys; sys.path.insert(0, 'custom'); import dreamcatalyst.train.edit, dreamcatalyst.render.cpu.api\n"
        "from dreamcatalyst.loss.image import ssim_map\n"
        "assert not {'beartype', 'typeguard'} & set(sys.modules)\n"
        "assert not hasattr(ssim_map, '__wrapped__')"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
