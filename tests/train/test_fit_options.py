"""What a fit does about photographs that are not all alike: exposures, masks, backgrounds, and sampling of splats."""

import cv2
import numpy as np
import pytest
import torch
from dreamcatalyst.train.exposure import Exposures

from benchmarks.faulty.things import HEIGHT, WIDTH, colmap, masks

BRIEF = ["data.width=null", "data.height=null", "trainer.max_steps=6", "system.sh_every=2"]
FEW = ["checkpoint.every_n_train_steps=3", "checkpoint.save_top_k=-1"]


@pytest.fixture
def capture(tmp_path):
    colmap(tmp_path / "capture")
    return tmp_path / "capture"


def test_exposures_are_found_and_their_mean_is_the_identity():
    draw = torch.Generator().manual_seed(0)
    true = torch.eye(3, 4).repeat(3, 1, 1) + 0.1 * torch.randn(3, 3, 4, generator=draw)
    true -= true.mean(0) - torch.eye(3, 4)
    exposures, images = Exposures([4, 7, 9], 0.02, torch.device("cpu")), torch.rand(3, 9, 9, 3, generator=draw)
    seen = torch.einsum("bhwi,boi->bhwo", images, true[..., :3]) + true[:, None, None, :, 3]
    for step in range(300):
        (exposures(images, [4, 7, 9]) - seen).square().mean().backward()
        exposures.step(step / 300)
    torch.testing.assert_close(exposures.colours.detach(), true, atol=5e-3, rtol=0)
    torch.testing.assert_close(exposures.colours.detach().mean(0), torch.eye(3, 4), atol=1e-6, rtol=0)
    assert torch.equal(exposures(images[:1], [7])[0], exposures(images[:1].repeat(3, 1, 1, 1), [4, 7, 9])[1])


def test_what_a_mask_leaves_out_has_no_influence(capture, launch, tmp_path):
    masks(capture / "masks")  # the left halves count
    options = [f"data.source={capture}", "data.masks=masks", *BRIEF]
    first = launch("fit.yaml", *options)
    assert "psnr_photo_inside" in (first / "report/summary.json").read_text()
    for path in sorted((capture / "images").glob("*.png")):
        image = cv2.imread(str(path))
        image[:, WIDTH // 2 :] = 255 - image[:, WIDTH // 2 :]
        path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    second, other = launch("fit.yaml", *options), launch("fit.yaml", f"data.source={capture}", *BRIEF)
    splats = [(trial / "save/last.ply").read_bytes() for trial in (first, second, other)]
    assert splats[0] == splats[1] != splats[2]


def test_a_transparent_photograph_shows_the_background_of_the_step(capture, monkeypatch, launch):
    from dreamcatalyst.train.fit import FitMethod

    pixels = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 4), np.uint8)
    for i in range(8):
        (capture / f"images/{i:03d}.png").write_bytes(cv2.imencode(".png", np.roll(pixels, i, 0))[1].tobytes())
    seen = []
    target = FitMethod.target
    monkeypatch.setattr(FitMethod, "target", lambda self, i, b: seen.append((i, b, out := target(self, i, b))) or out)
    launch("fit.yaml", f"data.source={capture}", "system.random_background=true", *BRIEF)
    assert len(seen) == 6 and len({tuple(background.tolist()) for _, background, _ in seen}) == 6
    for index, background, got in seen:
        rolled = torch.from_numpy(np.roll(pixels, index, 0)[..., [2, 1, 0, 3]].copy()).float() / 255
        alpha = rolled[..., 3:]
        torch.testing.assert_close(got, rolled[..., :3] * alpha + background * (1 - alpha), atol=0.003, rtol=0)


@pytest.mark.parametrize(
    "options",
    [
        ["system.exposure=0.01", "system.random_background=true"],
        ["system.densify={strategy: mcmc, every: 2, start: 1, stop: 6, max_splats: 60}"],
    ],
)
def test_a_resumed_fit_has_the_bits_of_one_that_was_not_interrupted(capture, launch, options):
    given = [f"data.source={capture}", *BRIEF, *FEW, *options]
    whole = launch("fit.yaml", *given)
    bits = (whole / "save/last.ply").read_bytes()
    (half,) = (whole / "ckpts").glob("*step=3.ckpt")
    (whole / "save/last.ply").unlink()
    launch("fit.yaml", *given, f"resume={half}")
    assert (whole / "save/last.ply").read_bytes() == bits


def test_what_words_name_is_left_out_with_what_the_mask_leaves_out(capture, launch, monkeypatch, tmp_path):
    from dreamcatalyst.train.fit import FitMethod

    from tests.segment.small_models import make_clipseg

    masks(capture / "masks")
    model, found = make_clipseg(tmp_path / "clipseg"), {}
    find = FitMethod._find_kept
    monkeypatch.setattr(FitMethod, "_find_kept", lambda self, i: found.setdefault(i, (self, find(self, i)))[1])
    words = f"system.leave_out={{text: person. sky, path: {model}, threshold: 0.5}}"
    launch("fit.yaml", f"data.source={capture}", "data.masks=masks", words, *BRIEF)
    for index, (method, kept) in found.items():
        named = method.finder(method.photo(index))
        assert torch.equal(kept[..., 0], (1 - named) * method.capture.kept(index)[..., 0])
    assert len(found) > 4
