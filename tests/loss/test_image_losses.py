"""SSIM against its published definition, written out by hand with scipy."""

import numpy as np
import pytest
import torch
from dreamcatalyst.loss.image import photometric_loss, ssim_map
from scipy.ndimage import correlate1d


def by_hand(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    x = np.arange(-5, 6)
    w = np.exp(-(x**2) / (2 * 1.5**2))
    w /= w.sum()

    def blur(m):
        return correlate1d(correlate1d(m, w, axis=0, mode="constant"), w, axis=1, mode="constant")

    ma, mb = blur(a), blur(b)
    va, vb, cov = blur(a * a) - ma**2, blur(b * b) - mb**2, blur(a * b) - ma * mb
    c1, c2 = 0.01**2, 0.03**2
    return (2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2))


@pytest.mark.parametrize("size", [(17, 23), (3, 4), (1, 1)])
def test_ssim_is_the_published_one(size):
    rng = np.random.default_rng(0)
    a, b = rng.random((*size, 3)), rng.random((*size, 3))
    got = ssim_map(torch.from_numpy(a)[None], torch.from_numpy(b)[None])[0].numpy()
    expected = np.stack([by_hand(a[..., c], b[..., c]) for c in range(3)], -1)
    np.testing.assert_allclose(got, expected, atol=1e-10)


def test_equal_images_lose_nothing():
    image = torch.rand(2, 9, 9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert photometric_loss(image, image).item() == pytest.approx(0, abs=1e-12)


def test_without_ssim_it_is_l1():
    a, b = torch.zeros(1, 4, 4, 3), torch.full((1, 4, 4, 3), 0.25)
    assert photometric_loss(a, b, 0).item() == pytest.approx(0.25)


@pytest.mark.parametrize("size", [(2, 17, 23, 3), (1, 3, 4, 3), (1, 1, 1, 1)])
def test_the_loss_on_the_cpu_is_that_of_the_map_and_so_is_its_gradient(size):
    rng = torch.Generator().manual_seed(2)
    a, b = (torch.rand(size, dtype=torch.float64, generator=rng) for _ in range(2))
    a.requires_grad_()
    loss = photometric_loss(a, b, 0.3)
    slow = 0.7 * (a - b).abs().mean() + 0.3 * (1 - ssim_map(a, b).mean())
    assert loss.item() == pytest.approx(slow.item(), abs=1e-12)
    torch.testing.assert_close(*(torch.autograd.grad(value, a)[0] for value in (loss, slow)), atol=1e-12, rtol=1e-9)


def test_gradient():
    generator = torch.Generator().manual_seed(1)
    a = torch.rand(1, 5, 6, 3, dtype=torch.float64, generator=generator, requires_grad=True)
    b = torch.rand(1, 5, 6, 3, dtype=torch.float64, generator=generator)
    torch.autograd.gradcheck(lambda x: photometric_loss(x, b), (a,), fast_mode=True)
