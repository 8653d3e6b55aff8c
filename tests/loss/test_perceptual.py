"""LPIPS against its definition, on weights of the published files' names and shapes."""

import pytest
import torch
from dreamcatalyst.errors import ConfigError
from dreamcatalyst.loss.perceptual import BLOCKS, WEIGHT_BYTES, Lpips, standardised


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Random weights in the layout of torchvision's VGG-16 and of LPIPS."""
    g, vgg, linear = torch.Generator().manual_seed(0), {}, {}
    place, channels = 0, 3
    for number, widths in enumerate(BLOCKS):
        for width in widths:
            vgg[f"features.{place}.weight"] = torch.randn(width, channels, 3, 3, generator=g) / (9 * channels) ** 0.5
            vgg[f"features.{place}.bias"] = torch.zeros(width)
            place, channels = place + 2, width
        place += 1
        linear[f"lin{number}.model.1.weight"] = torch.rand(1, widths[-1], 1, 1, generator=g)
    path = tmp_path_factory.mktemp("lpips")
    torch.save(vgg, path / "vgg16-397923af.pth")
    torch.save(linear, path / "vgg.pth")
    return path


def test_layer_numbers_are_those_of_torchvision(folder):
    names = {int(n.split(".")[1]) for n in torch.load(folder / "vgg16-397923af.pth")}
    assert sorted(names) == [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]


def test_bytes_of_the_weights():
    assert WEIGHT_BYTES == 4 * 14_714_688  # VGG-16's convolutions


def test_a_distance(folder):
    lpips, g = Lpips(folder), torch.Generator().manual_seed(1)
    a, b = torch.rand(1, 32, 40, 3, generator=g), torch.rand(1, 32, 40, 3, generator=g)
    assert float(lpips(a, a)) == 0
    assert float(lpips(a, b)) > 0
    torch.testing.assert_close(lpips(a, b), lpips(b, a))
    near = a + 0.05 * (b - a)
    assert float(lpips(a, near)) < float(lpips(a, b))


def test_a_batch_is_the_mean_of_its_images(folder):
    lpips, g = Lpips(folder), torch.Generator().manual_seed(2)
    a, b = torch.rand(2, 16, 16, 3, generator=g), torch.rand(2, 16, 16, 3, generator=g)
    torch.testing.assert_close(lpips(a, b), (lpips(a[:1], b[:1]) + lpips(a[1:], b[1:])) / 2)


def test_it_has_a_gradient_and_takes_small_images(folder):
    lpips = Lpips(folder)
    a = torch.rand(1, 9, 12, 3, generator=torch.Generator().manual_seed(3), requires_grad=True)
    lpips(a, torch.zeros_like(a)).backward()
    assert torch.isfinite(a.grad).all() and float(a.grad.abs().max()) > 0


def test_images_are_standardised_by_the_statistics_of_imagenet():
    mean, deviation = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    colours = torch.stack([mean, mean + deviation]).view(1, 1, 2, 3)
    expected = torch.tensor([0.0, 1.0]).expand(1, 3, 1, 2)
    torch.testing.assert_close(standardised(colours), expected, rtol=0, atol=1e-4)


def test_missing_and_wrong_files(folder, tmp_path):
    with pytest.raises(ConfigError, match="VGG-16 weights"):
        Lpips(tmp_path)
    torch.save({"features.0.weight": torch.zeros(64, 3, 3, 3)}, tmp_path / "vgg16.pth")
    torch.save({}, tmp_path / "vgg.pth")
    with pytest.raises(ConfigError, match=r"features\.0\.bias"):
        Lpips(tmp_path)
