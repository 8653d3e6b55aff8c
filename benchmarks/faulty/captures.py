"""Captures: photographs that are missing or of another kind, cameras that no lens has, files of other programs."""

from __future__ import annotations

import json
import math
import shutil
import struct
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from .cases import Case, Outcome, Place, case
from .things import HEIGHT, SCENE, WIDTH, photograph, poses, transforms

fit = partial(case, config="fit", seconds=10)
G, T, C, I = "capture", "transforms.json", "COLMAP", "cameras.json"  # groups


def changed(**values: object) -> Callable[[Place], list[str]]:
    """Values of the whole transforms.json."""
    return lambda place: transforms(place, lambda meta: meta.update(values))


def without(*keys: str) -> Callable[[Place], list[str]]:
    """Keys of the whole transforms.json that are not there."""

    def drop(meta: dict) -> None:
        for key in keys:
            del meta[key]

    return lambda place: transforms(place, drop)


def field_of_view(angle: object) -> Callable[[Place], list[str]]:
    """An angle in place of the focal lengths."""

    def change(meta: dict) -> None:
        del meta["fl_x"], meta["fl_y"]
        meta["camera_angle_x"] = angle

    return lambda place: transforms(place, change)


def frame(**values: object) -> Callable[[Place], list[str]]:
    """Values of the third frame."""
    return lambda place: transforms(place, lambda meta: meta["frames"][2].update(values))


def text(content: str | bytes) -> Callable[[Place], list[str]]:
    """Another transforms.json."""

    def given(place: Place) -> list[str]:
        place.copy("scene.ply")
        place.copy("capture")
        place.write("capture/transforms.json", content)
        return SCENE

    return given


def files(change: Callable[[Path], object], thing: str = "capture") -> Callable[[Place], list[str]]:
    """A capture of which `change` has changed the folder."""

    def given(place: Place) -> list[str]:
        change(place.copy(thing, "capture"))
        place.copy("scene.ply")
        return SCENE

    return given


def colmap(file: str, change: Callable[[str], str | bytes]) -> Callable[[Place], list[str]]:
    """A COLMAP capture of which one file of the model is changed."""

    def given(place: Place) -> list[str]:
        path = place.copy("colmap", "capture") / "sparse/0" / file
        content = change(path.read_text())
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return ["data.source=capture"]

    return given


def binary(spoil: Callable[[Path], object]) -> Callable[[Place], list[str]]:
    """A COLMAP capture with a binary model, of which `spoil` has changed the folder."""

    def given(place: Place) -> list[str]:
        import pycolmap

        folder = place.copy("colmap", "capture") / "sparse/0"
        pycolmap.Reconstruction(str(folder)).write_binary(str(folder))
        for path in folder.glob("*.txt"):
            path.unlink()
        spoil(folder)
        return ["data.source=capture"]

    return given


def cut(path: Path, keep: float = 0.6) -> None:
    """The file as a broken download leaves it."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])


def inria(change: Callable[[list], object]) -> Callable[[Place], list[str]]:
    """A cameras.json beside the splats."""

    def given(place: Place) -> list[str]:
        place.copy("scene.ply")
        cameras = []
        for i, pose in enumerate(poses()):
            rotation = (pose[:3, :3] @ np.diag([1.0, -1, -1])).tolist()
            names = dict(id=i, img_name=f"{i:03d}", width=WIDTH, height=HEIGHT, fx=30.0, fy=30.0)
            cameras.append({**names, "position": pose[:3, 3].tolist(), "rotation": rotation})
        other = change(cameras)
        place.write("cameras.json", json.dumps(cameras if other is None else other))
        return ["data.source=", "system.gs_source=scene.ply"]

    return given


def huge_png(path: Path, width: int, height: int) -> Path:
    """A PNG that says that it is so large, and holds a few bytes of it."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(10))) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)
    return path


def rename_all(folder: Path, suffix: str) -> None:
    for path in sorted((folder / "images").iterdir()):
        path.rename(path.with_suffix(suffix))


def halves(folder: Path) -> None:
    """Photographs as a copy leaves them that was broken off: their headers are good."""
    for path in sorted((folder / "images").iterdir()):
        cut(path, 0.5)


def heic(folder: Path) -> None:
    """Photographs of a telephone under another name: the bytes of no picture that is read."""
    for path in sorted((folder / "images").iterdir()):
        path.write_bytes(b"\x00\x00\x00\x18ftypheic" + bytes(200))


def twice(meta: dict) -> None:
    """The first photograph, which is held out, as a training photograph too."""
    meta["frames"].insert(3, dict(meta["frames"][0]))


def millimetres(meta: dict) -> None:
    for each in meta["frames"]:
        for row in each["transform_matrix"][:3]:
            row[3] *= 1000


def nested(levels: int = 100_000) -> str:
    return "[" * levels + "]" * levels


def report_is_there(place: Place, outcome: Outcome) -> list[str]:
    """A run that goes on must end with its report."""
    there = any(name.endswith("report/index.html") for name in outcome.left)
    return [] if there else ["no report was written"]


def one_pixel(place: Place) -> list[str]:
    place.copy("scene.ply")
    place.copy("capture")
    return [*SCENE, "data.max_side=1", "system.report.video_frames=2"]


def video_is_there(place: Place, outcome: Outcome) -> list[str]:
    """What is said to be written must be there."""
    said = [line.split("wrote ", 1)[1] for line in outcome.text.splitlines() if line.startswith("wrote ")]
    return [f"said to be written and not there: {path}" for path in said if not (place.work / path).exists()]


def sizes(folder: Path) -> None:
    """Photographs that were turned or cropped, each with a camera of its own."""
    meta = json.loads((folder / "transforms.json").read_text())
    for i, each in enumerate(meta["frames"]):
        w, h = (WIDTH, HEIGHT) if i % 2 else (HEIGHT, WIDTH)
        photograph(folder / each["file_path"], i, w, h)
        each.update(w=w, h=h, cx=w / 2, cy=h / 2)
    (folder / "transforms.json").write_text(json.dumps(meta))


CASES: list[Case] = [
    fit(G, "a folder that is not there", ["data.source=nowhere"], "data.source", "nowhere"),
    fit(G, "an empty folder", files(lambda f: shutil.rmtree(f) or f.mkdir()), "data.source", "is no capture"),
    fit(G, "an empty value, data.source=", ["data.source="], "data.source"),
    fit(G, "a video file", lambda p: [f"data.source={p.write('walk.mp4', b'ftypmp42' * 30).name}"], "walk.mp4"),
    fit(G, "the PLY in place of the capture", lambda p: [f"data.source={p.copy('scene.ply').name}"], "scene.ply"),
    fit(G, "the folder of the photographs", lambda p: [f"data.source={p.copy('capture')}/images"], "24x18"),
    fit(
        G,
        "the folder above the capture",
        lambda p: p.copy("capture", "all/fox") and ["data.source=all"],
        "is no capture",
    ),
    fit(G, "a web address", ["data.source=https://example.org/fox"], "https:"),
    fit(G, "a path of another system", ["data.source=C:\\Users\\me\\fox"], "C:\\Users\\me\\fox"),
    fit(G, "a home folder that is not there", ["data.source=~/no/such/fox"], "no/such/fox"),
    fit(
        G,
        "photographs missing",
        files(lambda f: [p.unlink() for p in sorted((f / "images").iterdir())[:3]]),
        "3 of 8 photographs are missing",
    ),
    fit(G, "photographs renamed to .jpg", files(lambda f: rename_all(f, ".jpg")), "8 of 8 photographs are missing"),
    fit(G, "an empty photograph", files(lambda f: (f / "images/002.png").write_bytes(b"")), "002.png"),
    fit(G, "photographs cut off at half", files(halves), ".png", "copy it again"),
    fit(G, "a photograph that is text", files(lambda f: (f / "images/002.png").write_text("404")), "002.png"),
    fit(G, "photographs of a telephone (HEIC)", files(heic), "000.png"),
    fit(
        G,
        "a folder in place of a photograph",
        files(lambda f: (f / "images/002.png").unlink() or (f / "images/002.png").mkdir()),
        "002.png",
    ),
    fit(
        G,
        "a photograph of another shape",
        files(lambda f: photograph(f / "images/002.png", 2, 30, 18)),
        "002.png",
        "shape",
    ),
    fit(G, "photographs on their side", files(lambda f: photograph(f / "images/002.png", 2, HEIGHT, WIDTH)), "side"),
    fit(
        G,
        "a photograph of 200 megapixels that is cut off",
        files(lambda f: huge_png(f / "images/002.png", 24 * 700, 18 * 700)),
        "002.png",
    ),
    fit(
        G,
        "photographs of different sizes: the fit ends with its report",
        files(sizes),
        "wrote",
        status=0,
        check=report_is_there,
        seconds=40,
    ),
    fit(G, "images of one pixel", one_pixel, "wrote", status=0, check=video_is_there, seconds=40),
    fit(G, "one view only", lambda p: transforms(p, lambda m: m["frames"].__delitem__(slice(1, None))), "test_every"),
    fit(G, "no view", changed(frames=[]), "transforms.json", "empty"),
    fit(
        G,
        "data.format of another capture",
        lambda p: [*files(lambda f: None)(p), "data.format=colmap"],
        "data.source",
        "sparse",
    ),
    fit(
        G,
        "a fit on cameras without photographs",
        lambda p: [*inria(lambda c: None)(p), "data.source=cameras.json"],
        "no photographs",
    ),
    fit(
        G,
        "a dataparser that is not there",
        lambda p: [*files(lambda f: None)(p), "data.dataparser=none.json"],
        "none.json",
    ),
    fit(
        G,
        "a dataparser that is another file",
        lambda p: [*files(lambda f: None)(p), "data.dataparser=capture/transforms.json"],
        "transform",
    ),
    fit(T, "an empty file", text(""), "transforms.json"),
    fit(T, "cut off", text('{"fl_x": 30.0, "frames": [{"file_path": "images/0'), "transforms.json"),
    fit(T, "a comma too many", text('{"frames": [],}'), "transforms.json"),
    fit(T, "UTF-16", text(json.dumps({"frames": []}).encode("utf-16")), "transforms.json"),
    fit(T, "a list", text("[]"), "transforms.json", "frames"),
    fit(T, "null", text("null"), "transforms.json", "frames"),
    fit(T, "100,000 brackets", text(nested()), "transforms.json"),
    fit(T, "frames that are no list", changed(frames={"0": {}}), "frames"),
    fit(T, "a frame that is a number", lambda p: transforms(p, lambda m: m["frames"].append(5)), "frame 8"),
    fit(
        T,
        "a frame without a matrix",
        lambda p: transforms(p, lambda m: m["frames"][2].pop("transform_matrix") and None),
        "frame 2",
        "transform_matrix",
    ),
    fit(T, "file_path: 5", frame(file_path=5), "frame 2", "file_path"),
    fit(T, "file_path: null", frame(file_path=None), "frame 2", "file_path"),
    fit(T, "file_path: empty", frame(file_path=""), "transforms.json"),
    fit(T, "a matrix of zeros", frame(transform_matrix=np.zeros((4, 4)).tolist()), "frame 2"),
    fit(T, "a matrix with NaN", frame(transform_matrix=[[math.nan] * 4] * 4), "transforms.json"),
    fit(T, "a matrix of text", frame(transform_matrix="identity"), "frame 2", "transform_matrix"),
    fit(T, "a matrix of 2x2", frame(transform_matrix=[[1, 0], [0, 1]]), "frame 2", "transform_matrix"),
    fit(T, "a mirrored matrix", frame(transform_matrix=np.diag([-1.0, 1, 1, 1]).tolist()), "images/002.png"),
    fit(T, "a scaled matrix", frame(transform_matrix=np.diag([2.0, 2, 2, 1]).tolist()), "images/002.png"),
    fit(
        T,
        "a translation that is infinite",
        frame(transform_matrix=[[1, 0, 0, math.inf], [0, 1, 0, 0], [0, 0, 1, 0]]),
        "transforms.json",
    ),
    fit(T, "no focal length", without("fl_x", "fl_y"), "fl_x"),
    *(
        fit(T, f"{key}: {value}", changed(**{key: value}), key)
        for key, value in [
            ("fl_x", 0),
            ("fl_x", -30),
            ("fl_x", math.nan),
            ("fl_x", "wide"),
            ("fl_y", math.inf),
            ("fl_x", None),
            ("w", 0),
            ("w", math.inf),
            ("w", -24),
            ("h", math.nan),
            ("cx", math.nan),
            ("cy", math.inf),
            ("k1", math.nan),
            ("p1", "none"),
        ]
    ),
    *(
        fit(T, f"camera_angle_x: {angle}", field_of_view(angle), "camera_angle_x")
        for angle in (0, -1, 40.0, math.nan, "wide")
    ),
    fit(T, "a camera model that is not known", changed(camera_model="EQUIRECTANGULAR"), "EQUIRECTANGULAR"),
    fit(T, "a point cloud that is not there", changed(ply_file_path="sparse.ply"), "sparse.ply"),
    fit(T, "a point cloud that is a folder", changed(ply_file_path="images"), "images"),
    fit(T, "a point cloud that is a number", changed(ply_file_path=5), "ply_file_path"),
    fit(T, "the same frame twice", lambda p: transforms(p, twice), "images/000.png", "twice"),
    fit(C, "no model in sparse", files(lambda f: shutil.rmtree(f / "sparse/0"), "colmap"), "sparse"),
    fit(C, "points3D missing", files(lambda f: (f / "sparse/0/points3D.txt").unlink(), "colmap"), "points3D"),
    fit(C, "no folder of photographs", files(lambda f: (f / "images").rename(f / "input"), "colmap"), "data.images"),
    fit(
        C,
        "data.images with a typo",
        lambda p: [*files(lambda f: None, "colmap")(p), "data.images=imges"],
        "imges",
        "data.images",
    ),
    fit(C, "a photograph missing", files(lambda f: (f / "images/003.png").unlink(), "colmap"), "003.png"),
    fit(C, "an empty cameras.txt", colmap("cameras.txt", lambda t: ""), "sparse"),
    fit(C, "an empty images.txt", colmap("images.txt", lambda t: ""), "empty reconstruction"),
    fit(C, "no points", colmap("points3D.txt", lambda t: ""), "points"),
    fit(C, "a point that is NaN", colmap("points3D.txt", lambda t: t.replace(t.split()[1], "nan", 1)), "sparse"),
    fit(C, "focal length 0", colmap("cameras.txt", lambda t: t.replace(" 30 30 ", " 0 0 ")), "capture", "focal"),
    fit(C, "focal length NaN", colmap("cameras.txt", lambda t: t.replace(" 30 30 ", " nan nan ")), "capture"),
    fit(C, "a size of 0", colmap("cameras.txt", lambda t: t.replace(f" {WIDTH} {HEIGHT} ", " 0 0 ")), "capture"),
    fit(C, "an unknown camera model", colmap("cameras.txt", lambda t: t.replace("PINHOLE", "PANORAMA")), "sparse"),
    fit(C, "text that is another file", colmap("images.txt", lambda t: "hello world\n" * 9), "sparse"),
    fit(C, "cameras.txt of a picture's bytes", colmap("cameras.txt", lambda t: bytes(range(256))), "sparse"),
    fit(C, "binary, images.bin cut off", binary(lambda f: cut(f / "images.bin")), "images.bin", "truncated"),
    fit(C, "binary, points3D.bin cut off", binary(lambda f: cut(f / "points3D.bin")), "points3D.bin", "truncated"),
    fit(C, "binary, cameras.bin cut off", binary(lambda f: cut(f / "cameras.bin")), "sparse"),
    fit(C, "binary, an empty file", binary(lambda f: (f / "images.bin").write_bytes(b"")), "images.bin"),
    fit(
        C,
        "binary, random bytes",
        binary(lambda f: (f / "images.bin").write_bytes(np.random.default_rng(0).bytes(999))),
        "images.bin",
    ),
    case(I, "an object", inria(lambda c: {"cameras": c}), "cameras.json", "list"),
    case(I, "numbers", inria(lambda c: [1, 2, 3]), "cameras.json", "camera 0"),
    case(I, "null", inria(lambda c: [None]), "cameras.json", "camera 0"),
    case(I, "an empty list", inria(lambda c: c.clear()), "cameras.json", "empty"),
    case(I, "a camera without a position", inria(lambda c: c[1].pop("position") and None), "camera 1", "position"),
    case(I, "infinite width", inria(lambda c: c[1].update(width=math.inf)), "camera 1", "width"),
    case(I, "a width of 0", inria(lambda c: c[1].update(width=0)), "cameras.json", "width"),
    case(I, "fx: 0", inria(lambda c: c[1].update(fx=0)), "cameras.json", "fx"),
    case(I, "fy: NaN", inria(lambda c: c[1].update(fy=math.nan)), "cameras.json", "fy"),
    case(I, "a rotation of 2x2", inria(lambda c: c[1].update(rotation=[[1, 0], [0, 1]])), "camera 1"),
    case(I, "a rotation of zeros", inria(lambda c: c[1].update(rotation=np.zeros((3, 3)).tolist())), "cameras.json"),
    case(I, "a position of NaN", inria(lambda c: c[1].update(position=[math.nan] * 3)), "cameras.json"),
]
