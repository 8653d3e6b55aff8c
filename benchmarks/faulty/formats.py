"""Splat files of other formats than PLY: damaged, empty, of other versions, that promise more than they hold; and
exports that cannot be."""

from __future__ import annotations

import gzip
import io
import json
import os
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch

from .cases import ROOT, Case, Place, case, command

ORBIT = ["data.source=", "data.orbit_views=4", "data.test_every=2"]
SUFFIXES = {"spz": ".spz", "sog": ".sog", "gltf": ".glb", "splat": ".splat", "compressed-ply": ".compressed.ply"}
splat_file = partial(case, "splat file")


@cache
def good(name: str, **options: Any) -> bytes:
    """A file of 40 good splats."""
    from dreamcatalyst.scene.formats.api import write_splats
    from dreamcatalyst.scene.gaussians import Gaussians

    draw = torch.Generator().manual_seed(0)
    means, ones = torch.rand(40, 3, generator=draw) - 0.5, torch.ones(40)
    scene = Gaussians.from_colors(means, ones[:, None].repeat(1, 3) * 0.1, means + 0.5, ones * 0.9, sh_degree=1)
    with tempfile.TemporaryDirectory() as folder:
        return write_splats(Path(folder) / "a", scene, name, options=options).path.read_bytes()


def given(name: str, content: bytes | Callable[[], bytes], *more: str) -> Callable[[Place], Sequence[str]]:
    """An edit of the splats in a file of this name and content."""

    def arguments(place: Place) -> Sequence[str]:
        place.write(name, content() if callable(content) else content)
        return [*ORBIT, f"system.gs_source={name}", *more]

    return arguments


def cut(kind: str, share: float) -> Callable[[Place], Sequence[str]]:
    """The first part of a good file."""
    return given(f"scene{SUFFIXES[kind]}", lambda: good(kind)[: int(share * len(good(kind)))])


def spz(**header: int) -> Callable[[], bytes]:
    """A .spz whose header says something else: version, count, degree, bits."""
    places = {"version": (4, 4), "count": (8, 4), "degree": (12, 1), "bits": (13, 1)}

    def content() -> bytes:
        raw = bytearray(gzip.decompress(good("spz")))
        for key, value in header.items():
            start, size = places[key]
            raw[start : start + size] = value.to_bytes(size, "little")
        return gzip.compress(bytes(raw))

    return content


def bomb() -> bytes:
    """A .spz of 2 MB whose gzip stream holds 2 GB, for a header that says so."""
    squeeze = zlib.compressobj(9, zlib.DEFLATED, 31)
    parts = [squeeze.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 2 * 10**9 // 20, 0, 12, 0, 0))]
    block = bytes(1 << 24)
    parts += [squeeze.compress(block) for _ in range(120)]
    return b"".join([*parts, squeeze.flush()])


def sog(change: Callable[[dict[str, Any]], Any], without: str = "", **pictures: bytes) -> Callable[[], bytes]:
    """A .sog whose meta.json is changed, which lacks a picture, or has other ones."""

    def content() -> bytes:
        out = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(good("sog"))) as old, zipfile.ZipFile(out, "w") as new:
            for name in old.namelist():
                data = old.read(name)
                if name == "meta.json":
                    meta = json.loads(data)
                    change(meta)
                    data = json.dumps(meta).encode()
                data = pictures.get(name.split(".")[0], data)
                if name != without:
                    new.writestr(name, data)
        return out.getvalue()

    return content


def gltf(change: Callable[[dict[str, Any]], Any]) -> Callable[[], bytes]:
    """A .glb whose JSON is changed."""

    def content() -> bytes:
        data = good("gltf")
        size = int.from_bytes(data[12:16], "little")
        tree = json.loads(data[20 : 20 + size])
        change(tree)
        text = json.dumps(tree).encode()
        text += b" " * (-len(text) % 4)
        rest = data[20 + size :]
        head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
        return head + struct.pack("<II", len(text), 0x4E4F534A) + text + rest

    return content


def splat(**values: float) -> Callable[[], bytes]:
    """A .splat whose first scale is another number."""
    return lambda: good("splat")[:12] + struct.pack("<f", values["scale"]) + good("splat")[16:]


def huge_picture() -> bytes:
    """A WebP whose header says 16384 x 16384 pixels."""
    return b"RIFF\x20\0\0\0WEBPVP8L\x10\0\0\0\x2f" + (0x3FFF | 0x3FFF << 14).to_bytes(4, "little") + bytes(20)


def export(
    name: str, given: Sequence[str], *says: str, make: Callable[[Place], Any] | None = None, **more: Any
) -> Case:
    """`--export` of good splats."""

    def arguments(place: Place) -> Sequence[str]:
        place.write("scene.splat", good("splat"))
        if make is not None:
            make(place)
        config = ["--config", str(ROOT / "configs/convert.yaml"), "--export", "system.gs_source=scene.splat"]
        return [*config, "data.max_side=24", "trainer.accelerator=cpu", *given]

    return command("export", name, arguments, *says, **more)


def read_only(place: Place) -> None:
    (place / "closed").mkdir()
    (place / "closed").chmod(0o500)


def primitive(tree: Mapping[str, Any]) -> dict[str, Any]:
    return tree["meshes"][0]["primitives"][0]


WEB = b"<!DOCTYPE html><html>404</html>" + bytes(300)
CASES: list[Case] = [
    *(splat_file(f"{kind}: empty", cut(kind, 0.0), f"scene{SUFFIXES[kind]}") for kind in SUFFIXES),
    *(splat_file(f"{kind}: half of it", cut(kind, 0.49), f"scene{SUFFIXES[kind]}") for kind in SUFFIXES),
    *(splat_file(f"{kind}: without its last bytes", cut(kind, 0.99), f"scene{SUFFIXES[kind]}") for kind in SUFFIXES),
    *(splat_file(f"{kind}: a web page", given(f"scene{SUFFIXES[kind]}", WEB), "scene") for kind in SUFFIXES),
    splat_file("no such file", [*ORBIT, "system.gs_source=scene.spz"], "scene.spz: no such file"),
    splat_file("a format that is not known", given("scene.obj", b"v 0 0 0\n"), "scene.obj", "Known:", ".ksplat"),
    splat_file(
        "a folder", lambda p: (p / "scene.sog").mkdir() or [*ORBIT, "system.gs_source=scene.sog"], "is a folder"
    ),
    splat_file(
        "spz under the name of a PLY: the run goes on",
        given("scene.ply", lambda: good("spz")),
        "whatever its name says",
        status=0,
        seconds=30,
    ),
    splat_file("spz: version 9", given("scene.spz", spz(version=9)), "version 9", "2, 3 or 4"),
    splat_file("spz: SH degree 4", given("scene.spz", spz(degree=4)), "SH degree 4", "3 at most"),
    splat_file("spz: zero splats", given("scene.spz", spz(count=0)), "zero splats"),
    splat_file("spz: 4e9 splats promised", given("scene.spz", spz(count=2**32 - 1)), "cannot hold"),
    splat_file("spz: 200 bits behind the point", given("scene.spz", spz(bits=200)), "200 bits"),
    splat_file("spz: a bomb of 2 GB", given("scene.spz", bomb), "scene.spz", seconds=60),
    splat_file("spz 4: cut off", given("scene.spz", lambda: good("spz", version=4)[:200]), "truncated"),
    splat_file(
        "spz 4: a stream that is no zstd",
        given("scene.spz", lambda: good("spz", version=4)[:140] + bytes(60) + good("spz", version=4)[200:]),
        "damaged",
    ),
    splat_file("gzip of something else", given("scene.spz", gzip.compress(b"text " * 99)), "NGSP"),
    splat_file(
        "sog: a zip archive of something else", given("scene.sog", sog(dict.clear, "meta.json")), "no meta.json"
    ),
    splat_file("sog: a picture is missing", given("scene.sog", sog(lambda m: None, "quats.webp")), "no quats.webp"),
    splat_file("sog: version 7", given("scene.sog", sog(lambda m: m.update(version=7))), "version 7", "1 or 2"),
    splat_file("sog: 1e18 splats promised", given("scene.sog", sog(lambda m: m.update(count=10**18))), "meta.json"),
    splat_file("sog: 4e9 splats promised", given("scene.sog", sog(lambda m: m.update(count=4 * 10**9))), "4000000000"),
    splat_file("sog: a count that is a word", given("scene.sog", sog(lambda m: m.update(count="many"))), "'many'"),
    splat_file(
        "sog: bounds that are not finite",
        given("scene.sog", sog(lambda m: m["means"].update(mins=[1e999] * 3))),
        "means.mins",
    ),
    splat_file(
        "sog: a codebook of 3 numbers",
        given("scene.sog", sog(lambda m: m["scales"].update(codebook=[1, 2, 3]))),
        "scales.codebook",
    ),
    splat_file(
        "sog: a picture outside of it",
        given("scene.sog", sog(lambda m: m["sh0"].update(files=["/etc/passwd"]))),
        "/etc/passwd",
    ),
    splat_file(
        "sog: a picture of 16384 x 16384", given("scene.sog", sog(lambda m: None, quats=huge_picture())), "16384x16384"
    ),
    splat_file(
        "sog: a picture that is none", given("scene.sog", sog(lambda m: None, scales=b"no picture")), "scales.webp"
    ),
    splat_file(
        "sog: a meta.json that is a list",
        lambda p: p.write("s/meta.json", "[]") and [*ORBIT, "system.gs_source=s"],
        "meta.json",
    ),
    splat_file(
        "sog: a folder without its pictures",
        lambda p: (
            p.write("s/meta.json", zipfile.ZipFile(io.BytesIO(good("sog"))).read("meta.json"))
            and [*ORBIT, "system.gs_source=s"]
        ),
        "is missing",
    ),
    splat_file(
        "gltf: a mesh",
        given("scene.glb", gltf(lambda t: primitive(t).pop("extensions"))),
        "without splats",
        "system.mesh",
    ),
    splat_file(
        "gltf: without rotations",
        given("scene.glb", gltf(lambda t: primitive(t)["attributes"].pop("KHR_gaussian_splatting:ROTATION"))),
        "ROTATION",
    ),
    splat_file(
        "gltf: 4e9 splats promised",
        given("scene.glb", gltf(lambda t: t["accessors"][0].update(count=4 * 10**9))),
        "truncated",
    ),
    splat_file(
        "gltf: a negative offset",
        given("scene.glb", gltf(lambda t: t["bufferViews"][0].update(byteOffset=-8))),
        "byteOffset is -8",
    ),
    splat_file(
        "gltf: accessors that are not there", given("scene.glb", gltf(lambda t: t.update(accessors=[]))), "accessors[0]"
    ),
    splat_file(
        "gltf: a node below itself",
        given("scene.glb", gltf(lambda t: t["nodes"][0].update(children=[0]))),
        "below itself",
    ),
    splat_file(
        "gltf: stretched", given("scene.glb", gltf(lambda t: t["nodes"][0].update(scale=[1, 2, 3]))), "stretches"
    ),
    splat_file(
        "gltf: data elsewhere",
        given(
            "scene.gltf",
            lambda: json.dumps({"asset": {"version": "2.0"}, "nodes": [], "scenes": [{"nodes": []}]}).encode(),
        ),
        "without splats",
    ),
    splat_file("gltf: JSON that is none", given("scene.gltf", b"{asset"), "JSON"),
    splat_file("splat: not a multiple of 32 bytes", given("scene.splat", bytes(99)), "32"),
    splat_file("splat: NaN scales", given("scene.splat", splat(scale=float("nan"))), "scales"),
    splat_file("splat: scales of 1e30", given("scene.splat", splat(scale=1e30)), "scales beyond"),
    splat_file("ksplat: too short", given("scene.ksplat", bytes(99)), "truncated"),
    splat_file("ksplat: version 7", given("scene.ksplat", b"\x07\x01" + bytes(5000)), "version 7.1"),
    splat_file("ksplat: 4e9 sections", given("scene.ksplat", b"\0\1\0\0" + b"\xff" * 16 + bytes(5000)), "sections"),
    splat_file(
        "compressed PLY without chunks",
        given("scene.compressed.ply", lambda: good("compressed-ply").replace(b"element chunk", b"element chonk")),
        "chunk",
    ),
    export("a format that is not known", ["export.format=spzz"], "export.format", "Did you mean 'spz'?"),
    export("a format that is only read", ["export.format=ksplat"], "ksplat", "only read"),
    export("an option that is not known", ["export.format=spz", "export.options={versoin: 4}"], "versoin"),
    export("an option out of range", ["export.format=spz", "export.options={version: 1}"], "export.options.version"),
    export("options of another format", ["export.format=splat", "export.options={version: 3}"], "version"),
    export("a key that is not known", ["export.file=a.spz"], "export", "file"),
    export("a name of another format", ["export.format=spz", "export.path=a.sog"], "a.sog", "spz"),
    export("a section that is a word", ["export=spz"], "export"),
    export("views below 0", ["export.views=-1"], "export.views"),
    export("no splats", ["export.path=a.spz", "system.gs_source=''"], "data.source"),
    export("a path that is a folder", ["export.path=there.spz"], "there.spz", make=lambda p: (p / "there.spz").mkdir()),
    *(
        []
        if os.geteuid() == 0  # whom no folder is closed to
        else [export("a folder that is read-only", ["export.path=closed/a.spz"], "closed", make=read_only)]
    ),
    export("on a device that is full", ["export.path=/dev/full/a.spz"], "/dev/full"),
    export(
        "an earlier file stays where splats are missing",
        ["export.path=kept.spz", "system.gs_source=none.ply"],
        "none.ply",
        make=lambda p: p.write("kept.spz", b"earlier"),
    ),
]
