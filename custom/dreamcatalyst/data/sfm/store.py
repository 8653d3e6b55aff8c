"""Where cameras that were found are kept, and finding them: a folder for each content, made once, by one process."""

from __future__ import annotations

import dataclasses
import json
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ... import kept, plugin
from ...files import file_digest, write_text
from . import check, orient, picture
from .colmap import library
from .options import SfmOptions
from .prepare import Picture
from .reconstruct import Found, Search

VERSION = 1  # of what is kept: another one is made anew
WHOLE = 64 << 20  # bytes of a file up to which all of them are hashed; of a longer one, such as a video, blocks are
BLOCKS, BLOCK = 64, 1 << 20
REPORT, PICTURES = "report.json", "pictures.json"

Prepare = Callable[[Path], tuple[list[Picture], list[str]]]


def content(path: Path) -> str:
    """A digest of what is in a file: of all of it, or of a large one of its size and of blocks spread over it."""
    size = path.stat().st_size
    if size <= WHOLE:
        return file_digest(path)
    parts = []
    with path.open("rb") as file:
        for place in np.linspace(0, size - BLOCK, BLOCKS).astype(int):
            file.seek(int(place))
            parts.append(file.read(BLOCK))
    return kept.digest(size, parts)


def cameras(
    source: Path, contents: Sequence[tuple[str, str]], video: bool, options: SfmOptions, prepare: Prepare
) -> Path:
    """The folder, a COLMAP capture with a report, of the photographs whose names and contents these are; they are made
    where they are not kept.

    prepare: makes the working copies in the folder that it gets, once, and gives them and what is to be said of them.
    Raises DataError: no cameras can be found, with the reason; ConfigError: the folder cannot be written.
    """
    without = ("registered",) if video else ("registered", "step")  # which change nothing of what is found
    asked = {f.name: getattr(options, f.name) for f in dataclasses.fields(options) if f.name not in without}
    folder = kept.home() / "captures" / kept.digest(VERSION, video, list(contents), asked)
    if not (folder / REPORT).is_file():
        told = f"cameras: another process finds those of {source}: waiting for it"
        with kept.alone(folder, lambda: plugin.info(told)):
            if not (folder / REPORT).is_file():
                _make(folder, source, video, options, prepare)
    return folder


def _make(folder: Path, source: Path, video: bool, options: SfmOptions, prepare: Prepare) -> None:
    plugin.info(f"cameras of {source} are found now, and kept in {folder}. Ctrl-C loses nothing of it")
    began = time.monotonic()
    folder.mkdir(exist_ok=True)
    pictures, said = _prepared(folder, prepare)
    search = Search(source, folder, pictures, video, options, {"photographs": round(time.monotonic() - began, 1)})
    found = search.run()
    check.require(source, found.model, search.names, found.database, options)
    facts = _write(folder, found)
    placed = {found.model.images[i].name for i in found.model.reg_image_ids()}
    aside = [each.original for each in pictures if each.name not in placed]
    n, what = len(pictures), "frames" if video else "photographs"
    said = [*said, f"{source}: {len(placed)} of {n} {what} have a camera, found {found.how}; kept in {folder}"]
    if aside:
        said.append(f"{source}: no camera for {check.names_of(aside)}, which are left out: they overlap too little")
    if found.others:
        said.append(
            f"{source}: the {what} fall into parts that nothing connects; the largest is used, of {len(placed)} "
            f"(others: {', '.join(map(str, found.others))}). Take some that show both parts at once"
        )
    facts |= {"source": str(source), "photographs": n, "not_registered": aside}
    facts |= {"seconds": search.seconds, "notices": said}
    title = f"{len(placed)} of {n} {what}, {facts['points']:,} points, {facts['reprojection_error']:.2f} px"
    _picture(folder, found.model, title)
    shutil.rmtree(folder / "models", ignore_errors=True)
    write_text(folder / REPORT, json.dumps(facts, indent=1, ensure_ascii=False))


def _prepared(folder: Path, prepare: Prepare) -> tuple[list[Picture], list[str]]:
    """The working copies, made at the first time."""
    listed = folder / PICTURES
    if listed.is_file():
        state = json.loads(listed.read_text(encoding="utf-8"))
        pictures = [Picture(**each) for each in state["pictures"]]
        if all((folder / "images" / each.name).is_file() for each in pictures):
            return pictures, state["notices"]
    pictures, notices = prepare(folder / "images")
    state = {"pictures": [dataclasses.asdict(each) for each in pictures], "notices": notices}
    write_text(listed, json.dumps(state, indent=1, ensure_ascii=False))
    return pictures, notices


def _write(folder: Path, found: Found) -> dict[str, Any]:
    """Write the model as sparse/0, in a world of sensible axes and size, and the similarity that led there."""
    scale, rotation, translation = orient.similarity(*orient.poses(found.model))
    with library() as pycolmap:
        matrix = np.concatenate([scale * rotation, translation[:, None]], axis=1)
        found.model.transform(pycolmap.Sim3d(matrix))
        part, sparse = folder / "sparse.part", folder / "sparse"
        shutil.rmtree(part, ignore_errors=True)
        shutil.rmtree(sparse, ignore_errors=True)
        (part / "0").mkdir(parents=True)
        found.model.write(part / "0")
        told = {
            "what": "x = scale * rotation @ x_colmap + translation, from COLMAP's own world into that of sparse/0",
            "scale": scale,
            "rotation": rotation.tolist(),
            "translation": translation.tolist(),
        }
        write_text(part / "similarity.json", json.dumps(told, indent=1))
        part.rename(sparse)
        model = found.model
        return {
            "registered": model.num_reg_images(),
            "points": model.num_points3D(),
            "reprojection_error": round(float(model.compute_mean_reprojection_error()), 4),
            "observations_per_photograph": round(float(model.compute_mean_observations_per_reg_image()), 1),
            "parallax": round(check.parallax(model), 2),
            "found": found.how,
            "cameras": [f"{c.model_name} {c.width}x{c.height} {c.params_to_string()}" for c in model.cameras.values()],
            "pycolmap": pycolmap.__version__,
        }


def _picture(folder: Path, model: Any, title: str) -> None:
    rotations, centres, xyz = orient.poses(model)
    rgb = np.array([point.color for point in model.points3D.values()]).reshape(-1, 3) / 255
    picture.draw(folder / "cameras.png", rotations, centres, xyz, rgb, title)


def notices(folder: Path) -> list[str]:
    """What is to be said of the cameras that are kept in `folder`."""
    return json.loads((folder / REPORT).read_text(encoding="utf-8"))["notices"]
