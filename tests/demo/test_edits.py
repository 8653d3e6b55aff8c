"""Edits of synthetic scenes: what they name, what they change, and what they leave alone to the bit."""

from __future__ import annotations

import pytest
import torch
from dreamcatalyst.demo.coats import PANDA_SHAPE, colors_of, metal, ramp, reshaped
from dreamcatalyst.demo.edits import EDITS, NOTHING, apply_edit, find_edit, normalised, possible
from dreamcatalyst.demo.random_world import random_world
from dreamcatalyst.demo.shapes import facing
from dreamcatalyst.demo.worlds import part_mask, statue_world
from dreamcatalyst.errors import ConfigError
from dreamcatalyst.scene.gaussians import PARAMETERS

ANIMALS = ("panda", "polar bear", "grizzly bear")


@pytest.fixture(scope="module")
def worlds():
    return [statue_world(views=1), *(random_world(seed, views=1, size=16) for seed in range(4))]


@pytest.fixture(scope="module")
def statue():
    return statue_world(views=1)


def part_color(world, name, part):
    scene = apply_edit(world, name)
    return colors_of(scene)[part_mask(scene, part)].mean(0)


def test_the_worlds_have_every_target(worlds):
    missing = {edit.target for edit in EDITS.values() if edit.target}
    for seed in range(30):
        missing -= {thing.name for thing in random_world(seed, views=1).things}
        if not missing:
            break
    assert not missing


@pytest.mark.parametrize("index", range(5))
def test_every_edit_keeps_what_is_not_its_own(worlds, index):
    world = worlds[index]
    for edit in (edit for edit in possible(world) if not edit.adds):
        scene = apply_edit(world, edit.name)
        kept = torch.ones(len(world.scene), dtype=torch.bool)
        if edit.target:
            first, last = world.thing(edit.target).rows
            kept[first:last] = False
        else:
            kept[:] = edit.name == NOTHING
        assert len(scene) == len(world.scene) and torch.equal(scene.extra["part"], world.scene.extra["part"])
        for name in PARAMETERS:
            before, after = getattr(world.scene, name), getattr(scene, name)
            assert torch.equal(before[kept], after[kept]), (edit.name, name)
            assert after.isfinite().all()
            if edit.name not in ANIMALS and name != ("logit_opacities" if edit.name.startswith("no ") else "sh0"):
                assert torch.equal(before, after), (edit.name, name)
        if edit.name.startswith("no "):  # nothing of it is drawn
            assert scene.opacities[~kept].max() < 1 / 255 and world.scene.opacities[~kept].min() > 0.5
            continue
        changed = colors_of(scene)[~kept]
        assert not len(changed) or (changed - colors_of(world.scene)[~kept]).abs().mean() > 0.02, edit.name
        assert not len(changed) or (changed.min() >= -1e-5 and changed.max() <= 1 + 1e-5)


@pytest.mark.parametrize("name, part", [("party hat", "hat"), ("rabbit ears", "rabbit ear"), ("scarf", "scarf")])
def test_what_an_edit_adds_stands_where_it_belongs(statue, name, part):
    scene, n = apply_edit(statue, name), len(statue.scene)
    assert EDITS[name].adds and EDITS[name].weight == 0  # the small model's training does not draw it
    for parameter in PARAMETERS:
        assert torch.equal(getattr(scene, parameter)[:n], getattr(statue.scene, parameter)), parameter
        assert getattr(scene, parameter)[n:].isfinite().all()
    assert torch.equal(part_mask(scene, part).nonzero()[:, 0], torch.arange(n, len(scene))) and len(scene) > n + 200
    solids = {solid.name: solid for solid in statue.thing("bear statue").solids}
    new, head = scene.means[n:], solids["head"]
    if name == "scarf":
        assert new[:, 2].max() < head.center[2] and (solids["body"].local(new).norm(dim=1) > 0.9).float().mean() > 0.6
    else:
        assert new[:, 2].max() > head.center[2] + 1.9 * head.radii[2]  # beyond the outline
        assert torch.cdist(new, statue.scene.means[slice(*head.rows)]).min() < 0.03  # and it touches the head


def test_an_edit_gives_the_same_again(statue):
    for name in ("panda", "autumn"):
        assert torch.equal(apply_edit(statue, name).sh0, apply_edit(statue_world(views=1), name).sh0)


def test_a_panda_is_black_and_white(statue):
    for part in ("ear", "nose", "arm", "leg"):
        assert part_color(statue, "panda", part).max() < 0.12, part
    assert part_color(statue, "panda", "muzzle").min() > 0.55
    scene, head = apply_edit(statue, "panda"), statue.thing("bear statue").solids[2]
    low = part_mask(scene, "belly", "body") & (scene.means[:, 2] < 0.5)  # below the band over the shoulders
    assert colors_of(scene)[low].min() > 0.3
    rows = slice(*head.rows)
    dark = colors_of(scene)[rows].mean(-1) < 0.2
    eyes = torch.stack([s.center for s in statue.thing("bear statue").solids if s.name == "eye"])
    away = torch.cdist(statue.scene.means[rows], eyes).amin(-1)
    assert dark[away < 0.03].all() and not dark[away > 0.13].any()  # patches around the eyes and nowhere else


def test_bears_have_their_colours(statue):
    polar, grizzly = (part_color(statue, name, "body") for name in ("polar bear", "grizzly bear"))
    assert polar.min() > 0.5 and polar[0] > polar[2]
    assert grizzly[0] > 1.5 * grizzly[1] > 1.5 * grizzly[2] > 0
    for name in ("polar bear", "grizzly bear"):
        assert part_color(statue, name, "nose").max() < 0.1


def test_shapes_move_splats_with_their_ellipsoids(statue):
    scene = apply_edit(statue, "panda")
    for solid in statue.thing("bear statue").solids:
        new = reshaped(solid, PANDA_SHAPE)
        rows = slice(*solid.rows)
        level = new.local(scene.means[rows]).norm(dim=1)
        torch.testing.assert_close(level, torch.ones_like(level), atol=1e-4, rtol=0)
        outward = ((scene.means[rows] - new.center) * facing(scene)[rows]).sum(1)
        assert (outward > 0).all()
        if solid.name in ("arm", "leg", "eye"):
            assert torch.equal(scene.means[rows], statue.scene.means[rows])


@pytest.mark.parametrize("name", ["red", "green", "blue"])
def test_paint_has_its_colour_and_keeps_the_light(statue, name):
    scene, rows = apply_edit(statue, f"{name} bear statue"), slice(*statue.thing("bear statue").rows)
    after, before = colors_of(scene)[rows], colors_of(statue.scene)[rows].mean(-1)
    assert after.mean(0).argmax() == ["red", "green", "blue"].index(name)
    assert torch.corrcoef(torch.stack([after.mean(-1), before]))[0, 1] > 0.95


def test_metal_gleams_towards_the_lamp(statue):
    scene = metal(statue, "bear statue", ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)))
    rows = slice(*statue.thing("bear statue").rows)
    normals, bright = facing(scene)[rows], colors_of(scene)[rows].mean(-1)
    lamp = normals @ torch.nn.functional.normalize(torch.tensor(statue.light.direction), dim=0)
    assert bright[lamp > 0.95].mean() > 2 * bright[lamp < 0].mean()


def test_a_ramp_is_linear_between_its_stops():
    stops = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    expected = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [1, 0, 0], [1, 0.5, 0.5], [1, 1, 1], [1, 1, 1]])
    torch.testing.assert_close(ramp(torch.tensor([-1.0, 0.25, 0.5, 0.75, 1, 2]), stops), expected)


def test_seasons_and_hours(statue):
    scene = statue.scene
    up, down = facing(scene)[:, 2] > 0.9, facing(scene)[:, 2] < -0.3
    ground, sky = part_mask(scene, "floor"), part_mask(scene, "sky")
    before = colors_of(scene)
    night, snow, sunset, autumn = (
        colors_of(apply_edit(statue, name)) for name in ("night", "snow", "sunset", "autumn")
    )
    assert night.mean() < 0.55 * before.mean() and (night.mean(0)[2] > night.mean(0)[:2]).all()
    assert snow[up & ~sky].amin(-1).quantile(0.05) > 0.75
    assert (snow[down & ~sky] - before[down & ~sky]).abs().max() < 0.12  # no snow from below
    assert sunset[sky].mean(0)[0] > 1.2 * sunset[sky].mean(0)[2]
    green = ground & (before[:, 1] > 1.2 * before[:, 0])
    assert (autumn[green, 0] > autumn[green, 1]).float().mean() > 0.98


def test_phrases_are_unique_and_find_their_edit():
    phrases = [normalised(phrase) for edit in EDITS.values() for phrase in edit.phrases]
    assert len(set(phrases)) == len(phrases)
    for edit in EDITS.values():
        assert len(edit.phrases) >= 6 and edit.scope == ("object" if edit.target else "global")
        for phrase in edit.phrases:
            for said in (phrase, phrase.upper(), f" {phrase.lower()}. "):
                assert find_edit(said) is edit, said
    assert find_edit("Turn the bear statue into a walrus") is None


@pytest.mark.parametrize(
    ("said", "name"),
    [
        ("Turn the bear statue into a panda", "panda"),
        ("Turn the bear statue into a polar bear", "polar bear"),
        ("Turn the bear statue into a grizzly bear", "grizzly bear"),
        ("Turn the bear statue into a bronze statue", "bronze statue"),
        ("Make it sunset", "sunset"),
        ("Make it autumn", "autumn"),
        ("Make it look like just snowed", "snow"),
        ("Make it night", "night"),
        ("Turn the bear statue golden", "golden bear statue"),
        ("Make the ball green", "green ball"),
        ("", NOTHING),
    ],
)
def test_the_papers_wording(said, name):
    assert find_edit(said).name == name
    assert said in EDITS[name].phrases[:2]  # the first, which training draws most


def test_unknown_edits_and_absent_targets_are_named(statue):
    with pytest.raises(ConfigError, match="unknown edit 'pandas'. Did you mean 'panda'"):
        apply_edit(statue, "pandas")
    with pytest.raises(ConfigError, match="unknown thing in this world 'ball'.*Known: bear statue"):
        apply_edit(statue, "red ball")
    assert "red ball" not in {edit.name for edit in possible(statue)}
