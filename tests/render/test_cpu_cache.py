"""The second start takes no compile time: what numba compiles stays on disk, and another process finds all of it."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DRAW = """
import sys
sys.path.insert(0, "custom")
import torch
from dreamcatalyst.data.camera import Cameras, look_at
from dreamcatalyst.render.api import rasterize
from dreamcatalyst.scene.gaussians import Gaussians
from numba.core.dispatcher import Dispatcher

eye = torch.tensor([[0.0, 0.0, -4.0]])
viewmat = look_at(eye, torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
camera = Cameras(viewmat, torch.tensor([[[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]]), 16, 16)
scene = Gaussians.from_colors(torch.randn(5, 3), torch.ones(5, 3), torch.ones(5, 3), torch.full((5,), 0.5), sh_degree=3)
for _, value in scene.parameters():
    value.requires_grad_()
rasterize(scene, camera, backend="cpu").rgb.sum().backward()
modules = [module for name, module in sys.modules.items() if ".render.cpu" in name]
kernels = {item for module in modules for item in vars(module).values() if isinstance(item, Dispatcher)}
kept = [kernel.stats for kernel in kernels if kernel.stats.cache_path]
print(sum(sum(s.cache_hits.values()) for s in kept), sum(sum(s.cache_misses.values()) for s in kept))
"""

SMALL = """
import sys
sys.path.insert(0, "custom")
import logging
logging.basicConfig()
from dreamcatalyst.render.cpu.jit import kernel

@kernel()
def one(x):
    return x + 1

@kernel()
def two(x):
    return one(x) + 1

print(two(1), "done")
"""


def test_a_second_process_compiles_nothing():
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", DRAW], cwd=ROOT, capture_output=True, text=True, check=True)
    hits, misses = map(int, done.stdout.split())
    assert hits >= 6 and misses == 0


def test_kernels_that_were_cut_off_are_compiled_anew_and_said(tmp_path):
    """The index of one kernel and the code of another; numba itself would end every later run."""
    script, environment = tmp_path / "script.py", {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    script.write_text(SMALL)

    def draw() -> subprocess.CompletedProcess:
        return subprocess.run(
            [sys.executable, str(script)], cwd=ROOT, capture_output=True, text=True, check=True, env=environment
        )

    assert "damaged" not in draw().stderr
    kinds = [sorted(tmp_path.rglob(pattern)) for pattern in ("*.nbi", "*.nbc")]
    assert kinds[0] and kinds[1]
    for number, files in enumerate(kinds):
        for path in files[number::2]:
            os.truncate(path, path.stat().st_size // 2)
    mended = draw()
    assert "a compiled kernel is damaged" in mended.stderr and mended.stdout.startswith("3 ")
    assert "damaged" not in draw().stderr
