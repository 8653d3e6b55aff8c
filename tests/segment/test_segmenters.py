"""What every segmenter keeps to: it finds the disc, in the world and not only in the pictures. A newcomer is picked up
by its registered name, and says in OPTIONS how it is to be asked."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from dreamcatalyst.config import parse
from dreamcatalyst.errors import ConfigError
from dreamcatalyst.segment.api import SEGMENTERS, MaskConfig, make_mask
from dreamcatalyst.segment.pictures import mask_panels, overlay, rendered_mask

from tests.segment.conftest import HEIGHT, RADIUS


def write_masks(folder: Path, images: dict[str, torch.Tensor]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in images.items():
        cv2.imwrite(str(folder / f"{name}.png"), (image * 255).round().byte().numpy())
    return folder


@pytest.fixture
def options(disc_world, tmp_path, clipseg):
    drawn = {f"{i:04d}": disc_world.views[i].clamp(0, 1) for i in range(5)}
    return {
        "files": {"folder": str(write_masks(tmp_path / "drawn", drawn))},
        "box": {"center": [0.0, 0.0, HEIGHT], "radius": 1.05 * RADIUS},
        "relevance": {},
        "text": {"text": "green disc", "path": str(clipseg)},
        "kept": {},
    }


def found(kind: str, given: dict, request, **changes):
    config = parse(MaskConfig, {"kind": kind, "options": given, **changes}, "system.mask")
    return make_mask(config, request)


@pytest.mark.parametrize("kind", SEGMENTERS.names())
def test_the_disc_is_found(kind, disc_world, options):
    mask = found(kind, options[kind], disc_world.request)
    n = len(disc_world.request.scene)
    assert mask.weights.shape == mask.mask.shape == mask.update.shape == (n,)
    assert mask.mask.dtype == torch.bool and mask.weights.min() >= 0 and mask.weights.max() <= 1
    both = float((mask.mask & disc_world.truth).sum())
    either = float((mask.mask | disc_world.truth).sum())
    assert both / either > 0.85
    assert torch.equal(mask.update, mask.mask.float())


@pytest.mark.parametrize("kind", SEGMENTERS.names())
def test_the_same_request_gives_the_same_bits(kind, disc_world, options):
    first, second = (found(kind, options[kind], disc_world.request) for _ in range(2))
    assert torch.equal(first.weights, second.weights)


@pytest.mark.parametrize("kind", SEGMENTERS.names())
def test_only_training_views_are_looked_at(kind, disc_world, options):
    asked = []
    request = dataclasses.replace(
        disc_world.request, render=lambda i: (asked.append(i), disc_world.request.render(i))[1]
    )
    mask = found(kind, options[kind], request)
    assert set(asked) | set(mask.images) <= set(request.views)


@pytest.mark.parametrize("kind", SEGMENTERS.names())
def test_options_of_another_kind_are_refused(kind, disc_world):
    with pytest.raises(ConfigError, match=r"system\.mask\.options: unknown key 'colour'"):
        found(kind, {"colour": "green"}, disc_world.request)


def test_only_what_is_asked_for_is_imported():
    code = (
        "import sys; sys.path.insert(0, 'custom')\n"
        "from dreamcatalyst.segment.api import SEGMENTERS, MaskConfig, make_mask\n"
        "assert make_mask(MaskConfig(), None) is None\n"
        "SEGMENTERS.get('box')\n"
        "loaded = {m for m in sys.modules if m.startswith('dreamcatalyst.segment.')}\n"
        "print(sorted(m.rsplit('.', 1)[1] for m in loaded), 'transformers' in sys.modules, 'numba' in sys.modules)\n"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['api', 'box', 'cache'] False False"


def test_kinds_and_values_are_checked():
    with pytest.raises(ConfigError, match=r"system\.mask: kind: unknown kind of mask 'txt'. Did you mean 'text'\?"):
        parse(MaskConfig, {"kind": "txt"}, "system.mask")
    with pytest.raises(ConfigError, match="vote: unknown vote 'weight'"):
        MaskConfig(vote="weight")
    with pytest.raises(ConfigError, match="threshold: got 0"):
        parse(MaskConfig, {"threshold": 0.0})
    with pytest.raises(ConfigError, match="feather: got -1"):
        parse(MaskConfig, {"feather": -1.0})


def test_threshold_grow_invert_feather_come_in_this_order(disc_world, options):
    request, truth = disc_world.request, disc_world.truth
    plain = found("box", options["box"], request)
    assert torch.equal(plain.mask, truth)
    outside = found("box", options["box"], request, invert=True)
    assert torch.equal(outside.mask, ~truth) and torch.equal(outside.weights, 1 - plain.weights)
    # The wall right behind the disc is HEIGHT away; the extent is 1.3.
    grown = found("box", options["box"], request, grow=1.1 * HEIGHT / 1.3)
    assert bool(grown.mask[truth].all()) and 20 < int(grown.mask[~truth].sum()) < 200
    assert torch.equal(found("box", options["box"], request, grow=1.1 * HEIGHT / 1.3, invert=True).mask, ~grown.mask)
    soft = found("box", options["box"], request, feather=2 * HEIGHT / 1.3)  # the nearest splat outside is HEIGHT away
    torch.testing.assert_close(soft.update, 0.5 * truth.float(), atol=0.03, rtol=0)


def test_written_pictures_give_the_same_mask_again(disc_world, options, tmp_path):
    """A mask may be written, drawn upon, and read: nothing is lost on the way."""
    first = found("relevance", {}, disc_world.request)
    names = {Path(disc_world.request.names[view]).stem: image for view, image in first.images.items()}
    again = found("files", {"folder": str(write_masks(tmp_path / "written", names))}, disc_world.request)
    assert torch.equal(first.weights, again.weights)


def test_the_unweighted_vote_is_there_by_name(disc_world, options):
    weighted = found("files", options["files"], disc_world.request)
    counted = found("files", options["files"], disc_world.request, vote="gaussian-editor")
    hidden = ~disc_world.truth & (disc_world.request.scene.means[:, :2].norm(dim=1) < 0.5 * RADIUS)  # behind the disc
    assert counted.weights[hidden].mean() > weighted.weights[hidden].mean()


def test_pictures_of_masks(disc_world, options):
    mask = found("files", options["files"], disc_world.request)
    panels = mask_panels(mask, disc_world.request, 1)
    assert [name for name, _ in panels] == ["source", "2D mask", "splats in the mask"]
    assert all(image.shape == (48, 56, 3) for _, image in panels)
    assert len(mask_panels(mask, disc_world.request, 3)) == 2  # held out: no picture of it
    seen = rendered_mask(mask.mask, disc_world.request, 3)
    assert float((seen - disc_world.views[3]).abs().mean()) < 0.02
    grey = torch.full((2, 2, 3), 0.5)
    shown = overlay(grey, torch.tensor([[1.0, 1.0], [0.0, 0.0]]))
    assert (shown[0, :, 0] > shown[0, :, 1]).all() and torch.equal(shown[1, :, 0], shown[1, :, 1])


def test_masks_are_numbers_of_eight_bits(disc_world):
    mask = found("relevance", {}, disc_world.request)
    for image in mask.images.values():
        steps = (image * 255).numpy()
        assert np.allclose(steps, steps.round(), atol=1e-4)
