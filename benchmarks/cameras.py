"""Cameras from photographs alone, against cameras that are known: how many, how far off, and how long each stage took.

python benchmarks/cameras.py --capture <COLMAP folder>                  # its photographs, against its own sparse/0
python benchmarks/cameras.py --capture <folder> --photographs 11        # of them 11, evenly spread; or --first 11
python benchmarks/cameras.py --capture <folder> --fit                   # and configs/fit.yaml on both sets of cameras
python benchmarks/cameras.py --world demo:statue                        # a video of an orbit around a synthetic scene

Errors are those after the best similarity (Umeyama 1991): of centres as a share of the cameras' extent (the largest
distance of one from their mean), of rotations in degrees. Seconds are those of the clock and of the processor. Nothing
is taken from the cache and nothing is left there, unless --kept names one. key=value goes to the capture's options
(data.sfm.features=4096). The fits differ in their cameras alone: photographs, size (data.downscale=4) and held-out
views are the same; --steps sets their length.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "custom"))

from dreamcatalyst.config import parse  # noqa: E402
from dreamcatalyst.data.camera import Cameras, look_at  # noqa: E402
from dreamcatalyst.data.formats import CaptureOptions  # noqa: E402
from dreamcatalyst.data.loader import open_capture  # noqa: E402
from dreamcatalyst.data.views import Capture  # noqa: E402
from dreamcatalyst.errors import DreamCatalystError  # noqa: E402
from omegaconf import OmegaConf  # noqa: E402

FRAMES, SIDE = 150, 640  # of the video of a synthetic scene


def aligned(found: np.ndarray, true: np.ndarray) -> tuple[float, np.ndarray]:
    """Scale and rotation of the best similarity from one set of centres [V,3] to another (Umeyama 1991)."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    U, S, Vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.linalg.det(U @ Vt)])
    return float((S * signs).sum() / (a**2).sum()), U @ np.diag(signs) @ Vt


def errors(found: Cameras, true: Cameras) -> dict[str, float]:
    """Errors of centres in percent of the extent and of rotations in degrees: median and largest."""
    a, b = found.centers.double().numpy(), true.centers.double().numpy()
    scale, R = aligned(a, b)
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    away = np.linalg.norm(scale * a @ R.T - b, axis=1) / np.linalg.norm(b, axis=1).max() * 100
    turns = found.viewmats[:, :3, :3].double().numpy() @ R.T @ true.viewmats[:, :3, :3].double().numpy().swapaxes(1, 2)
    angles = np.degrees(np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    return {
        "centres_median_percent": float(np.median(away)),
        "centres_largest_percent": float(away.max()),
        "rotations_median_degrees": float(np.median(angles)),
        "rotations_largest_degrees": float(angles.max()),
    }


def compare(capture: Capture, truth: dict[str, Cameras]) -> dict[str, float]:
    """The errors of the views of `capture` whose names are known."""
    views = [view for view in capture.views if Path(view.name).stem in truth]
    found = Cameras(torch.cat([view.camera.viewmats for view in views]), torch.eye(3).repeat(len(views), 1, 1), 1, 1)
    true = torch.cat([truth[Path(view.name).stem].viewmats for view in views])
    return errors(found, Cameras(true, torch.eye(3).repeat(len(views), 1, 1), 1, 1))


def found_in(capture: Capture) -> dict:
    """The report of how its cameras were found."""
    return json.loads((capture.found / "report.json").read_text(encoding="utf-8"))


def show(facts: dict, found: dict[str, float]) -> None:
    """Print what was found, what was measured, and the seconds."""
    counts = f"{facts['registered']} of {facts['photographs']} registered ({facts['found']})"
    print(f"{counts}, {facts['points']:,} points, {facts['reprojection_error']:.2f} px")
    print(f"errors: {', '.join(f'{name} {value:.3f}' for name, value in found.items())}")
    print(f"seconds: {', '.join(f'{stage} {seconds}' for stage, seconds in facts['seconds'].items())}", flush=True)


def world_video(source: str, folder: Path) -> tuple[Path, dict[str, Cameras]]:
    """A video of one turn around a synthetic scene, and the cameras by the names that its frames get."""
    from dreamcatalyst.demo.worlds import make_world
    from dreamcatalyst.render.api import rasterize

    world = make_world(source.removeprefix("demo:"))
    first = world.cameras.centers[0].double()
    radius, height = float(first[:2].norm()), float(first[2])
    angle = torch.arange(FRAMES).double() / FRAMES * 2 * torch.pi
    eye = torch.stack([radius * angle.cos(), radius * angle.sin(), torch.full_like(angle, height)], dim=1)
    target = torch.tensor([0.0, 0.0, 0.46]).double()
    viewmats = look_at(eye, target, torch.tensor([0.0, 0.0, 1.0]).double()).float()
    K = world.cameras.resized(SIDE, SIDE).Ks[:1].float()
    path = folder / "orbit.mp4"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25, (SIDE, SIDE))
    truth = {}
    with torch.no_grad():
        for i, viewmat in enumerate(viewmats):
            camera = Cameras(viewmat[None], K, SIDE, SIDE)
            rgb = rasterize(world.scene, camera).rgb[0].clamp(0, 1)
            video.write(np.ascontiguousarray((rgb.numpy()[..., ::-1] * 255).round().astype(np.uint8)))
            truth[f"frame_{i:06d}"] = camera
    video.release()
    return path, truth


def photographs_of(capture: Path, folder: Path, count: int | None, first: bool) -> tuple[Path, dict[str, Cameras]]:
    """Copies of the photographs of a capture, or of some, and the cameras that it has of them."""
    known = open_capture(capture, CaptureOptions(test_every=0))
    views = known.views
    if count is not None:
        places = range(count) if first else np.linspace(0, len(views) - 1, count).round().astype(int)
        views = [views[int(i)] for i in places]
    target = folder / "photographs"
    target.mkdir()
    for view in views:
        shutil.copy(view.photo.path, target / Path(view.name).name)
    return target, {Path(view.name).stem: view.camera for view in known.views}


def fit(source: Path | str, folder: Path, name: str, steps: int) -> float:
    """PSNR at the held-out views after configs/fit.yaml."""
    given = [f"data.source={source}", "data.downscale=4", "data.max_side=null", f"trainer.max_steps={steps}"]
    given += [
        f"exp_root_dir={folder}",
        "name=fit",
        f"tag={name}",
        "use_timestamp=false",
        "system.report.video_frames=0",
    ]
    command = [sys.executable, str(ROOT / "launch.py"), "--config", str(ROOT / "configs/fit.yaml"), *given]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=os.environ)
    mean = json.loads((folder / "fit" / name / "report" / "summary.json").read_text(encoding="utf-8"))["mean"]
    return mean[next(key for key in mean if key.startswith("psnr_"))]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--capture", type=Path, help="a folder with photographs and cameras that are known")
    what.add_argument("--world", help="a synthetic scene, such as demo:statue")
    parser.add_argument("--photographs", type=int, metavar="N", help="so many, evenly spread")
    parser.add_argument("--first", type=int, metavar="N", help="the first so many")
    parser.add_argument("--fit", action="store_true", help="fit splats on both sets of cameras, too")
    parser.add_argument("--steps", type=int, default=3500, help="of each fit")
    parser.add_argument("--kept", type=Path, metavar="DIR", help="the cache to use, so that a second command goes on")
    parser.add_argument("--write", type=Path, metavar="DIR", help="keep the report and its picture there")
    args, given = parser.parse_known_args()
    if wrong := [word for word in given if not word.startswith("data.")]:
        parser.error(f"unknown argument {wrong[0]}; options of the capture are data.key=value")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    merged = OmegaConf.from_dotlist([word.removeprefix("data.") for word in given])
    with tempfile.TemporaryDirectory(prefix="cameras-") as name:
        folder = Path(name)
        cache = (args.kept or folder / "kept").resolve()
        os.environ["DREAMCATALYST_CACHE"] = str(cache)
        try:
            options = parse(CaptureOptions, merged, "data")
            if args.world:
                source, truth = world_video(args.world, folder)
            else:
                count = args.first or args.photographs
                source, truth = photographs_of(args.capture, folder, count, args.first is not None)
            capture = open_capture(source, options)
        except DreamCatalystError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        facts = found_in(capture)
        show(facts, compare(capture, truth))
        if args.fit:
            known = args.capture or args.world
            with ThreadPoolExecutor() as pool:  # both at once: no time is taken
                runs = [pool.submit(fit, s, folder, n, args.steps) for s, n in ((source, "found"), (known, "known"))]
            found, shipped = (run.result() for run in runs)
            print(f"held-out PSNR: {found:.2f} dB with the cameras that were found, {shipped:.2f} dB with the known")
        if args.write:
            args.write.mkdir(parents=True, exist_ok=True)
            for file in ("report.json", "cameras.png"):
                shutil.copy(capture.found / file, args.write / file)
    return 0


if __name__ == "__main__":
    sys.exit(main())
