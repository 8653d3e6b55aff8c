"""Things that cannot be put in, and places where nothing can stand."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from .cases import Case, Outcome, Place, case

put = partial(case, "addition", config="add")
NO_PLACE = ["system.add.view=null", "system.add.pixel=null"]
BOX = """v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
f 1 2 3
f 1 3 4
"""
HEADER = "ply\nformat ascii 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\n"


def file(name: str, content: str | bytes, *more: str) -> Callable[[Place], Sequence[str]]:
    """A file of this content as the thing."""

    def given(place: Place) -> Sequence[str]:
        place.write(name, content)
        return [f"system.add.path={name}", *more]

    return given


def points(*rows: str) -> str:
    """A PLY of points."""
    return HEADER.format(count=len(rows)) + "end_header\n" + "".join(f"{row}\n" for row in rows)


def empty_glb() -> bytes:
    """A glTF with no mesh in it."""
    text = json.dumps({"asset": {"version": "2.0"}, "scenes": [{"nodes": []}], "scene": 0}).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text


def folder(place: Place) -> Sequence[str]:
    (place / "thing").mkdir()
    return ["system.add.path=thing"]


def nothing_written(place: Place, outcome: Outcome) -> Sequence[str]:
    """No splats may be left by a run that could not put its thing in."""
    return [f"left {path}" for path in outcome.left if Path(path).suffix == ".ply"]


def at(*pixel: float, view: str = "'0'") -> list[str]:
    return [f"system.add.view={view}", f"system.add.pixel={list(pixel)}"]


CASES: list[Case] = [
    put("thing: none named", ["system.add.path=''"], "system.add: path"),
    put("thing: no such file", ["system.add.path=no.obj"], "system.add.path", "no.obj"),
    put(
        "thing: a name with a typo",
        lambda p: p.write("bear.obj", BOX) and ["system.add.path=baer.obj"],
        "baer.obj",
        "bear.obj",
    ),
    put("thing: an empty folder", folder, "thing", "folder"),
    put("thing: a world that is not there", ["system.add.path=demo:statu"], "system.add.path", "statue"),
    put("thing: a world whose seed is a word", ["system.add.path=demo:random:x"], "system.add.path", "random"),
    put("mesh: an empty file", file("a.obj", ""), "a.obj"),
    put("mesh: text", file("a.obj", "no mesh"), "a.obj", "no faces"),
    put("mesh: bytes in an STL", file("a.stl", bytes(range(200))), "a.stl", "no faces"),
    put("mesh: of no known kind", file("a.xyzzy", BOX), "a.xyzzy", "trimesh"),
    put("mesh: vertices and no faces", file("a.off", "OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n"), "a.off", "no faces"),
    put("mesh: faces without area", file("a.obj", "v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n"), "a.obj", "no area"),
    put("mesh: a glTF with nothing in it", file("a.glb", empty_glb()), "a.glb", "no faces"),
    put("mesh: a glTF cut off", file("a.glb", empty_glb()[:30]), "a.glb"),
    put("mesh: flat, and a height asked for", file("a.ply", points("0 0 0", "1 0 0", "0 1 0")), "system.add.size"),
    put("mesh: no splats asked for", ["system.add.splats=0"], "system.add.splats"),
    put("points: none", file("a.ply", points()), "a.ply"),
    put("points: NaN among them", file("a.ply", points("0 0 0", "nan 1 0", "1 1 1")), "a.ply", "NaN"),
    put("points: all in one place", file("a.ply", points("0 0 0", "0 0 0")), "no size"),
    put("splats: a PLY cut off", lambda p: file("a.ply", b"ply\nformat binary_little_endian 1.0\n")(p), "a.ply"),
    put("splats: an .spz that is none", file("a.spz", b"no splats"), "a.spz"),
    put("place: a position and a pixel", ["system.add.position=[0, 0, 0]"], "system.add: position", "pixel"),
    put("place: a view without a pixel", ["system.add.pixel=null"], "system.add: pixel", "missing"),
    put("place: a pixel without a view", ["system.add.view=null"], "system.add: view", "missing"),
    put("place: a view that is not there", at(0.5, 0.5, view="'999'"), "system.add.view", "999"),
    put("place: a pixel outside of the view", at(9000, 10), "system.add.pixel", "24x24"),
    put("place: a pixel below it", at(10, 24), "system.add.pixel", "24x24"),
    put("place: a pixel of one number", ["system.add.pixel=[3]"], "system.add.pixel"),
    put("place: a pixel of NaN", ["system.add.pixel=[.nan, 1]"], "system.add.pixel"),
    put("place: a negative pixel", ["system.add.pixel=[-3, 1]"], "system.add.pixel"),
    put("place: a pixel of the sky", at(0.1, 0.05), "system.add.pixel", "tilted", check=nothing_written),
    put("place: a position of NaN", [*NO_PLACE, "system.add.position=[0, .nan, 0]"], "system.add.position"),
    put("place: a position of two numbers", [*NO_PLACE, "system.add.position=[0, 1]"], "system.add.position"),
    put("place: a position of words", [*NO_PLACE, "system.add.position=here"], "system.add.position"),
    put("rotation: two angles", ["system.add.rotation=[0, 90]"], "system.add: rotation"),
    put("rotation: NaN", ["system.add.rotation=[0, 0, .nan]"], "system.add.rotation"),
    put("rotation: a quaternion of zeros", ["system.add.rotation=[0, 0, 0, 0]"], "system.add: rotation"),
    *(
        put(f"size: {key} {value}", ["system.add.size=null", f"system.add.{key}={value}"], f"system.add.{key}")
        for key in ("scale", "height", "size")
        for value in ("0", "-1", ".nan", ".inf", "large")
    ),
    put("size: scale and size", ["system.add.scale=2"], "system.add: scale", "size"),
    put("up: no axis", ["system.add.up=w"], "system.add: up", "-y"),
    put("light: no such kind", ["system.add.light=shadin"], "system.add: light", "shading"),
    put("light: a gain of zero", ["system.add.gain=[1, 0, 1]"], "system.add.gain"),
    put("light: a gain of one number", ["system.add.gain=[2]"], "system.add.gain"),
    put("a key with a typo", ["system.add.rotaton=[0, 0, 0]"], "rotaton", "rotation"),
    put(
        "an edit by a prior that knows the world without it",
        ["system.prompt_processor.prompt=Make it night", "system.guidance.prior_type=world-truth"],
        "prior_type",
    ),  # fmt: skip
    put(
        "an edit whose source is another scene",
        lambda p: ["system.prompt_processor.prompt=Make it night", f"system.original={p.copy('scene.ply')}"],
        "system.original",
    ),  # fmt: skip
    put("an edit that the prior does not know", ["system.prompt_processor.prompt=Make it float"], "Make it float"),
]
