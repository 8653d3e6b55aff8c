"""Antithetic noise on the exact prior, whose gradient is affine in the noise."""

import torch
from dreamcatalyst.guidance.config import GuidanceConfig
from dreamcatalyst.guidance.guidance import Guidance


def gradient(kind: str, step: int = 3, visit: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    render, source = (torch.rand(1, 6, 5, 3, dtype=torch.float64, generator=generator) for _ in range(2))
    guidance = Guidance(GuidanceConfig(noise=kind), "Make it night")
    return guidance.step(render, source, [7], step, 10, [visit]).gradient


def mean_gradient() -> torch.Tensor:
    """Over many independent draws is slow; the noise-free one comes from drawing none."""
    guidance = Guidance(GuidanceConfig(), "Make it night")
    guidance.noise = lambda latents, index, step: torch.zeros_like(latents)
    generator = torch.Generator().manual_seed(0)
    render, source = (torch.rand(1, 6, 5, 3, dtype=torch.float64, generator=generator) for _ in range(2))
    return guidance.step(render, source, [7], 3, 10).gradient


def test_paired_noise_gives_the_mean_gradient():
    torch.testing.assert_close(gradient("paired"), mean_gradient(), rtol=1e-10, atol=1e-10)


def test_alternating_noise_cancels_over_two_visits():
    both = (gradient("alternating", visit=4) + gradient("alternating", visit=5)) / 2
    torch.testing.assert_close(both, mean_gradient(), rtol=1e-10, atol=1e-10)
    assert not torch.allclose(gradient("alternating", visit=4), gradient("alternating", visit=6))


def test_independent_noise_is_noisy_and_new_at_each_step():
    assert (gradient("independent") - mean_gradient()).abs().mean() > 0.1
    assert not torch.equal(gradient("independent", visit=0), gradient("independent", step=4))
