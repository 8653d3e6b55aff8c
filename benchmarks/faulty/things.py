"""Good things, made once, of which each case takes a copy and spoils it: splats, captures, a prior, trials, pairs."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from .cases import ROOT, Place, arguments, launched

WIDTH, HEIGHT, VIEWS = 24, 18, 8
TRIAL = "outputs/closed-form/trial"
SCENE = ["data.source=capture", "system.gs_source=scene.ply"]  # a run on `capture` and `scene.ply`
STEPS = ["trainer.max_steps=4", "checkpoint.every_n_train_steps=2", "checkpoint.save_top_k=-1"]
NAMED = ["use_timestamp=false", "tag=trial"]


def make(shop: Path, thing: str) -> Path:
    """The path of a thing, which is made at the first call."""
    path = shop / thing
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        THINGS[thing](path)
    return path


def splats(path: Path) -> None:
    """A PLY of 60 splats within half a unit of the origin."""
    from dreamcatalyst.scene.gaussians import Gaussians
    from dreamcatalyst.scene.ply import write_ply

    n, draw = 60, torch.Generator().manual_seed(0)
    scene = Gaussians(
        means=torch.rand(n, 3, generator=draw) - 0.5,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        log_scales=torch.full((n, 3), -2.0),
        logit_opacities=torch.full((n,), 2.0),
        sh0=torch.rand(n, 1, 3, generator=draw) - 0.5,
        shN=torch.zeros(n, 0, 3),
    )
    write_ply(path, scene)


def poses(n: int = VIEWS) -> list[np.ndarray]:
    """Cameras to world [4,4], OpenGL's axes, in a ring of radius 3 around the origin, which they look at."""
    out = []
    for angle in np.linspace(0, 2 * np.pi, n, endpoint=False):
        back = np.array([np.sin(angle), 0.0, np.cos(angle)])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([np.cross([0.0, 1, 0], back), [0.0, 1, 0], back], axis=1)
        pose[:3, 3] = 3 * back
        out.append(pose)
    return out


def photograph(path: Path, number: int = 0, width: int = WIDTH, height: int = HEIGHT) -> Path:
    """A picture of noise."""
    path.parent.mkdir(parents=True, exist_ok=True)
    noise = np.random.default_rng(number).integers(60, 190, (height, width, 3), np.uint8)
    path.write_bytes(cv2.imencode(path.suffix, noise)[1].tobytes())
    return path


def nerfstudio(path: Path) -> None:
    """A capture with transforms.json."""
    frames = []
    for i, pose in enumerate(poses()):
        photograph(path / f"images/{i:03d}.png", i)
        frames.append({"file_path": f"images/{i:03d}.png", "transform_matrix": pose.tolist()})
    lens = {"fl_x": 30.0, "fl_y": 30.0, "cx": 12.0, "cy": 9.0, "w": WIDTH, "h": HEIGHT}
    (path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))


def colmap(path: Path) -> None:
    """A capture with a COLMAP model in text."""
    folder = path / "sparse/0"
    folder.mkdir(parents=True)
    rows = []
    for i, pose in enumerate(poses()):
        photograph(path / f"images/{i:03d}.png", i)
        view = np.linalg.inv(pose @ np.diag([1.0, -1, -1, 1]))
        w, x, y, z = quaternion(view[:3, :3])
        rows.append(f"{i + 1} {w} {x} {y} {z} {view[0, 3]} {view[1, 3]} {view[2, 3]} 1 {i:03d}.png\n\n")
    (folder / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} 30 30 12 9\n")
    (folder / "images.txt").write_text("".join(rows))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    (folder / "points3D.txt").write_text(
        "".join(f"{i + 1} {x} {y} {z} 200 120 40 0.5\n" for i, (x, y, z) in enumerate(points))
    )


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """A rotation [3,3] as a quaternion, wxyz."""
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)


def model(path: Path) -> None:
    """A folder of the small prior that comes along; a copy, since cases spoil it."""
    shutil.copytree(ROOT / "custom/dreamcatalyst/demo/prior", path)


def trial(*overrides: str, config: str = "closed-form") -> Callable[[Path], None]:
    """A maker of a folder in which a run of four steps has ended: its inputs beside outputs/."""

    def run(path: Path) -> None:
        place = Place(path.with_name(f"{path.name}.made"), path.parent)
        place.copy("scene.ply")
        place.copy("colmap" if config == "fit" else "capture", "capture")
        outcome = launched(place, arguments(config, [*SCENE, *STEPS, *NAMED, *overrides]))
        if outcome.status != 0:
            raise RuntimeError(f"the good run that cases begin with failed:\n{outcome.text}")
        place.work.rename(path)

    return run


def pairs(path: Path) -> None:
    """Training pairs of one's own, 32 x 32 pixels: four worlds with four pairs each."""
    path.mkdir()
    for shard in range(2):
        np.savez(path / f"pairs-{shard:05d}.npz", **pair_arrays(shard))


def pair_arrays(shard: int, n: int = 8, size: int = 32) -> dict[str, np.ndarray]:
    """The arrays of a shard."""
    draw = np.random.default_rng(shard)
    return dict(
        source=draw.integers(0, 256, (n, size, size, 3), np.uint8),
        edited=draw.integers(0, 256, (n, size, size, 3), np.uint8),
        mask=np.full((n, size, size), 255, np.uint8),
        instruction=np.array(["make it snow"] * n),
        edit=np.array(["snow"] * n),
        world=np.repeat(np.arange(n // 4) + 2 * shard, 4).astype(np.int64),
    )


def host(path: Path) -> None:
    """What --link takes for a threestudio."""
    for name in ("threestudio", "custom"):
        (path / name).mkdir(parents=True)
    (path / "launch.py").touch()


def masks(path: Path) -> None:
    """A mask for each view of `capture`: its left half."""
    path.mkdir()
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, : WIDTH // 2] = 255
    for i in range(VIEWS):
        (path / f"{i:03d}.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())


THINGS: dict[str, Callable[[Path], None]] = {
    "scene.ply": splats,
    "capture": nerfstudio,
    "colmap": colmap,
    "model": model,
    "pairs": pairs,
    "host": host,
    "masks": masks,
    "edit": trial(),
    "fit": trial(config="fit"),
}


def transforms(place: Place, change: Callable[[dict], object]) -> list[str]:
    """A run on a capture whose transforms.json `change` has changed (what it returns, if anything, takes its place)."""
    place.copy("scene.ply")
    path = place.copy("capture") / "transforms.json"
    meta = json.loads(path.read_text())
    other = change(meta)
    path.write_text(json.dumps(meta if other is None else other))
    return SCENE


def link_files(source: Path, target: Path) -> Path:
    """A copy of a folder whose files are hard links: cheap, for cases that only take files away or put others there."""
    return Path(shutil.copytree(source, target, copy_function=os.link))
