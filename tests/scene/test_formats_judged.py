"""Splat formats before outside judges, each where it is: docs/formats.md says how to get them.

SPLAT_TRANSFORM is the command that runs PlayCanvas's splat-transform ("node .../cli.mjs"), which reads all formats but
glTF and writes all but .splat and .ksplat.
"""

from __future__ import annotations

import os
import shlex
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from dreamcatalyst.scene.formats.api import read_splats, write_splats
from dreamcatalyst.scene.formats.gltf import KHR
from dreamcatalyst.scene.formats.gltffile import GltfFile
from dreamcatalyst.scene.formats.quantized import turned
from dreamcatalyst.scene.gaussians import Gaussians
from dreamcatalyst.scene.ply import read_rows

from .splatfiles import apart, matched, splats

COMMAND = os.environ.get("SPLAT_TRANSFORM", "")
pytestmark = pytest.mark.skipif(not COMMAND, reason="SPLAT_TRANSFORM names no splat-transform to judge by")
EXACT = dict(means=2e-6, shape=2e-6, opacity=0.5 / 255 + 1e-6, sh0=2e-6, shN=2e-6)  # two readers of the same bytes


def judge(*arguments: object) -> None:
    subprocess.run([*shlex.split(COMMAND), "-q", "-w", "-g", "cpu", *map(str, arguments)], check=True, timeout=120)


def judged(path: Path) -> Gaussians:
    """What the judge reads of a file. It writes opacities of 0 and 1 as infinite logits."""
    judge(path, path.with_suffix(".judged.ply"))
    scene = read_rows(path.with_suffix(".judged.ply"))
    return replace(scene, logit_opacities=scene.logit_opacities.clamp(-20, 20))


def as_judge(scene: Gaussians, path: Path) -> Gaussians:
    """The judge leaves the axes of a .spz as they are."""
    return turned(scene, (1, -1, -1)) if path.suffix == ".spz" else scene


@pytest.mark.parametrize(("name", "options"), [
    ("ply", {}), ("compressed-ply", {}), ("splat", {}), ("sog", {}), ("sog", {"bundle": False}),
    ("spz", {"version": 3}), ("spz", {"version": 4}),
])  # fmt: skip
@pytest.mark.parametrize("degree", [0, 3])
def test_the_judge_reads_our_files_as_we_do(tmp_path, name, options, degree):
    path = write_splats(tmp_path / "ours", splats(300, degree), name, options=options).path
    ours = as_judge(read_splats(path), path)
    found = apart(matched(judged(path), ours), ours)
    limits = EXACT | (dict(shape=0.02) if name == "splat" else {})  # it takes the bytes of rotations a little otherwise
    assert {key: value for key, value in found.items() if value > limits[key]} == {}


@pytest.mark.parametrize(("suffix", "options"), [
    ("compressed.ply", []), ("sog", []), ("spz", ["--spz-version", "3"]), ("spz", ["--spz-version", "4"]),
])  # fmt: skip
@pytest.mark.parametrize("degree", [0, 3])
def test_we_read_the_judges_files_as_it_does(tmp_path, suffix, options, degree):
    source = write_splats(tmp_path / "source", splats(300, degree), "ply").path
    judge(*options, source, tmp_path / f"theirs.{suffix}")
    ours = as_judge(read_splats(tmp_path / f"theirs.{suffix}"), tmp_path / f"theirs.{suffix}")
    found = apart(matched(judged(tmp_path / f"theirs.{suffix}"), ours), ours)
    assert {key: value for key, value in found.items() if value > EXACT[key]} == {}


@pytest.mark.parametrize("degree", [0, 3])
def test_the_judges_gltf_is_ours(tmp_path, degree):
    scene = splats(300, degree)
    judge(write_splats(tmp_path / "source", scene, "ply").path, tmp_path / "theirs.glb")
    found = apart(read_splats(tmp_path / "theirs.glb"), scene)
    assert max(found.values()) < 1e-5
    files = [GltfFile(path) for path in (tmp_path / "theirs.glb", write_splats(tmp_path / "ours", scene, "gltf").path)]
    attributes = [next(file.instances())[1]["attributes"] for file in files]
    assert set(attributes[0]) == set(attributes[1])
    widths = {"COLOR_0": 4, f"{KHR}:ROTATION": 4, f"{KHR}:OPACITY": 1}
    for name in set(attributes[0]) - {f"{KHR}:ROTATION"}:  # the same ellipsoid has several
        theirs, ours = (f.accessor(a[name], widths.get(name, 3)) for f, a in zip(files, attributes, strict=True))
        assert np.allclose(theirs, ours, atol=1e-6), name
    assert torch.isfinite(read_splats(tmp_path / "ours.glb").quats).all()
