"""Splat formats: what is written comes back as exactly as the format says, and content says which one it is."""

from __future__ import annotations

import gzip
import json
import shutil
import zipfile
from dataclasses import replace

import pytest
import torch
from dreamcatalyst.errors import ConfigError, SceneError
from dreamcatalyst.scene.fitted import Fitted
from dreamcatalyst.scene.formats.api import (
    SPLATS,
    named,
    read_comments,
    read_splats,
    splat_origin,
    write_splats,
    writer,
)
from dreamcatalyst.scene.ply import write_ply

from .splatfiles import apart, splats

# How exact each is, by its definition: steps of bytes (1/255 of opacity and colour, of which half at most is lost),
# of 16ths of a logarithm, of 1/1023 of a quaternion's component, of fixed-point numbers.
BYTE = 0.5 / 255 + 1e-6
COLOR = BYTE / 0.28209479
LIMITS = {
    "ply": dict(means=0, shape=0, opacity=0, sh0=0, shN=0),
    "gltf": dict(means=0, shape=1e-5, opacity=1e-6, sh0=0, shN=0),
    "compressed-ply": dict(means=0.01, shape=0.02, opacity=BYTE, sh0=0.02, shN=8 / 512 + 1e-6),
    "spz": dict(means=0.5 / 4096 + 1e-6, shape=0.08, opacity=BYTE, sh0=0.5 / 255 / 0.15 + 1e-6, shN=1 / 16 + 1e-6),
    "splat": dict(means=0, shape=0.04, opacity=BYTE, sh0=float("inf"), shN=0),
    "sog": dict(means=2e-3, shape=0.15, opacity=BYTE, sh0=0.05, shN=float("inf")),
}
WRITTEN = [name for name in SPLATS.names() if SPLATS.get(name).write is not None]
OPTIONS = [(name, {}) for name in WRITTEN]
OPTIONS += [("spz", {"version": 4}), ("spz", {"version": 4, "axes": "RDF"})]
OPTIONS += [("gltf", {"separate": True}), ("sog", {"bundle": False})]


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize(("name", "options"), OPTIONS)
def test_a_format_gives_back_what_was_written(tmp_path, name, options, degree):
    if options.get("version") == 4:
        pytest.importorskip("zstandard")
    written = write_splats(tmp_path / "new" / "a.b", splats(300, degree), name, options=options)
    assert written.path.is_file() and written.path.parent.name in ("new", "a.b")
    back = read_splats(written.path)
    assert back.sh_degree == min(degree, SPLATS.get(name).sh_degree)
    visible = written.scene.opacities > 1 / 255  # a SOG keeps no colour of others
    found = apart(written.scene[visible], back[visible])
    assert {key: value for key, value in found.items() if value > LIMITS[name][key]} == {}
    assert apart(written.scene, back)["means"] <= LIMITS[name]["means"]


@pytest.mark.parametrize("name", WRITTEN)
def test_the_same_splats_give_the_same_bytes(tmp_path, name):
    paths = [write_splats(tmp_path / stem, splats(100), name).path for stem in "ab"]
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_content_decides_and_the_name_is_told(tmp_path, capsys):
    scene = splats(50)
    for name in ("ply", "compressed-ply", "spz", "sog", "gltf"):
        path = write_splats(tmp_path / name, scene, name).path
        wrong = shutil.copy(path, tmp_path / f"{name}.splat")
        assert len(read_splats(wrong)) == 50
        assert f"is a {SPLATS.get(name).title}, whatever its name says" in capsys.readouterr().out
        plain = shutil.copy(path, tmp_path / f"{name}.data")
        read_splats(plain, quiet=True)
        assert capsys.readouterr().out == ""
    (tmp_path / "x.bin").write_bytes(bytes(640))
    with pytest.raises(SceneError, match="no splat file that is known.*ksplat.*3DGS PLY"):
        read_splats(tmp_path / "x.bin")
    with pytest.raises(SceneError, match="no such file. Did you mean '.*spz.spz'"):
        read_splats(tmp_path / "spzz.spz")
    (tmp_path / "folder").mkdir()
    with pytest.raises(SceneError, match="is a folder"):
        read_splats(tmp_path / "folder")


def test_names_speak_of_formats():
    assert named("a.compressed.PLY")[1] == ".compressed.ply" and named("x/a.b.ply")[0] is SPLATS.get("ply")
    assert named("a/meta.json")[0] is SPLATS.get("sog") and named("a.obj") is None


def test_what_a_file_has_no_place_for_is_said(tmp_path):
    scene, comments = splats(20).with_extra(mask=torch.ones(20)), ["made by hand"]
    assert write_splats(tmp_path / "a", scene, "ply", comments=comments).left_out == []
    left = write_splats(tmp_path / "a", scene, "splat", comments=comments).left_out
    assert [text.split()[0:3] for text in left] == [
        ["the", "extra", "columns"],
        ["colours", "that", "depend"],
        ["the", "comments", "(made"],
    ]
    for name in ("ply", "compressed-ply", "gltf", "sog"):
        written = write_splats(tmp_path / "b", scene, name, comments=comments)
        assert read_comments(written.path) == comments
    assert read_comments(write_splats(tmp_path / "b", scene, "spz").path) == []


@pytest.mark.parametrize("name", ["ply", "compressed-ply", "gltf", "sog"])
def test_at_what_size_splats_were_fitted_travels(tmp_path, name):
    fitted = Fitted(256, 192, 210.2)
    path = write_splats(tmp_path / "a", splats(20), name, comments=[fitted.comment]).path
    assert Fitted.of(path) == fitted


@pytest.mark.parametrize("name", ["ply", "gltf"])
def test_worlds_far_away_keep_their_digits(tmp_path, name):
    origin, scene = (500_000.0, -4_000_000.0, 30.0), splats(40)
    path = write_splats(tmp_path / "a", scene, name, origin=origin).path
    assert torch.equal(read_splats(path, origin=origin).means, scene.means)
    found = splat_origin(path)
    assert max(abs(a - b) for a, b in zip(found, origin, strict=True)) < 20
    near = write_splats(tmp_path / "b", scene, name).path
    assert splat_origin(near) == (0.0, 0.0, 0.0)


def test_positions_of_spz_are_as_fine_as_its_world_lets_them_be(tmp_path):
    def error(scene):
        written = write_splats(tmp_path / "a", scene, "spz")
        return float((read_splats(written.path).means - scene.means).abs().max())

    scene = splats(50)
    assert error(scene) <= 0.5 / 2**12 + 1e-6  # what the reference writes
    small = replace(scene, means=scene.means / 1000, log_scales=scene.log_scales - 7)
    assert error(small) < 0.1 * float(small.scales.median())
    large = replace(scene, means=scene.means * 1000)  # +-10,000 units do not fit 24 bits with 12 behind the point
    assert 0.5 / 2**12 < error(large) < 1e-3 + 0.5 / 2**9


def test_formats_that_are_only_read_and_options_are_refused_by_name():
    with pytest.raises(ConfigError, match="export.format: 'ksplat' is only read.*compressed-ply"):
        writer("ksplat", {})
    with pytest.raises(ConfigError, match="Did you mean 'spz'"):
        writer("spzz", {})
    with pytest.raises(ConfigError, match="export.options.version: got 2"):
        writer("spz", {"version": 2})
    with pytest.raises(ConfigError, match="export.options: unknown key 'versoin'"):
        writer("spz", {"versoin": 3})


def test_what_is_not_finite_is_not_packed(tmp_path):
    scene = splats(10)
    scene.means[3, 1] = torch.nan
    with pytest.raises(SceneError, match="1 of 10 splats have NaN"):
        write_splats(tmp_path / "a", scene, "spz")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(SceneError, match="1 of 10 splats have NaN"):  # floats hold it, and reading finds it
        read_splats(write_ply(tmp_path / "a.ply", scene))
    assert len(read_splats(tmp_path / "a.ply", drop_nonfinite=True)) == 9


# --- files that promise more than they hold


@pytest.mark.parametrize("name", ["compressed-ply", "spz", "sog", "gltf", "splat"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.98])
def test_a_truncated_file_is_one_error(tmp_path, name, share):
    path = write_splats(tmp_path / "whole", splats(200), name).path
    short = tmp_path / path.name.replace("whole", "short")
    size = int(share * path.stat().st_size)
    short.write_bytes(path.read_bytes()[: size + (name == "splat")])
    with pytest.raises(SceneError, match="short"):
        read_splats(short)


def test_absurd_promises_are_found_before_memory_is_taken(tmp_path, monkeypatch):
    raw = gzip.decompress(write_splats(tmp_path / "a", splats(30), "spz").path.read_bytes())
    packed = gzip.compress(raw[:8] + (2**32 - 1).to_bytes(4, "little") + raw[12:])
    (tmp_path / "many.spz").write_bytes(packed)
    with pytest.raises(SceneError, match="cannot hold the 4294967295 splats promised"):
        read_splats(tmp_path / "many.spz")
    bomb = raw[:8] + (10**6).to_bytes(4, "little") + raw[12:16] + bytes(65 * 10**6)
    (tmp_path / "bomb.spz").write_bytes(gzip.compress(bomb, 9))
    monkeypatch.setattr("dreamcatalyst.scene.formats.api.free_memory", lambda: 1e6)
    with pytest.raises(SceneError, match="promises 1000000 splats, which take 0.2 GiB; 0.0 GiB are free"):
        read_splats(tmp_path / "bomb.spz")


def test_a_picture_of_a_sog_is_not_larger_than_its_splats_need(tmp_path):
    from dreamcatalyst.scene.formats import webp

    meta = write_splats(tmp_path / "a", splats(30), "sog", options={"bundle": False}).path
    huge = bytearray(webp.encode(torch.zeros(4, 4, 3, dtype=torch.uint8).numpy()))
    huge[21:25] = (0x3FFF | 0x3FFF << 14).to_bytes(4, "little")  # 16384 x 16384, says its header
    (meta.parent / "quats.webp").write_bytes(huge)
    with pytest.raises(SceneError, match="quats.webp: is 16384x16384 pixels, expected"):
        read_splats(meta)
    told = json.loads(meta.read_text())
    told["quats"]["files"] = ["../quats.webp"]
    meta.write_text(json.dumps(told))
    with pytest.raises(SceneError, match="'../quats.webp', expected a name"):
        read_splats(meta)


def test_a_sog_whose_archive_is_not_one(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * (1 << 25))
    with pytest.raises(SceneError, match="meta.json is more than 16777216 bytes"):
        read_splats(tmp_path / "a.sog")
