"""FreeU: the sites of the paper's code, its arithmetic against a Fourier transform, and that it leaves no trace."""

from __future__ import annotations

import itertools

import pytest
import torch
from dreamcatalyst.config import parse
from dreamcatalyst.diffusion.freeu import FreeU, FreeUConfig, filter_low_frequencies, freeu_sites
from dreamcatalyst.errors import ConfigError, PriorError

from tests.diffusion.small_model import FULL, SMALL, unet_config

# All of up-blocks 0 and 1 and the first of 2; the last two of 2 and the first of 3.
WIDEST = [f"up_blocks.{i}.resnets.{j}" for i, j in [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (2, 0)]]
HALF = ["up_blocks.2.resnets.1", "up_blocks.2.resnets.2", "up_blocks.3.resnets.0"]


def make_unet(**changes):
    from diffusers import UNet2DConditionModel

    torch.manual_seed(0)
    return UNet2DConditionModel(**unet_config(SMALL, **changes)).requires_grad_(False).eval()


@pytest.fixture(scope="module")
def unet():
    return make_unet()


def run(unet, h=8, w=8, dtype=torch.float32):
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(2, 8, h, w, generator=generator).to(dtype)
    text = torch.randn(2, 5, SMALL["text"], generator=generator).to(dtype)
    with torch.no_grad():
        return unet(x, torch.tensor(500), encoder_hidden_states=text).sample


def fourier(x, s):
    """The paper's code in words: centre the spectrum, scale rows and columns c-1 and c around its centre, go back."""
    spectrum = torch.fft.fftshift(torch.fft.fftn(x.double(), dim=(-2, -1)), dim=(-2, -1))
    rows, columns = ({max(n // 2 - 1, 0), n // 2} for n in x.shape[-2:])
    for row, column in itertools.product(rows, columns):
        spectrum[..., row, column] *= s
    return torch.fft.ifftn(torch.fft.ifftshift(spectrum, dim=(-2, -1)), dim=(-2, -1)).real


def test_seven_and_three_sites_on_stable_diffusion():
    from diffusers import UNet2DConditionModel

    with torch.device("meta"):
        full = UNet2DConditionModel(**unet_config(FULL))
    sites = freeu_sites(full)
    assert [s.name for s in sites if s.stage == 1] == WIDEST
    assert [s.name for s in sites if s.stage == 2] == HALF
    assert {s.backbone for s in sites if s.stage == 1} == {1280}
    assert {s.backbone for s in sites if s.stage == 2} == {640}


def test_sites_are_relative_to_the_width(unet):
    sites = freeu_sites(unet)
    assert [s.name for s in sites if s.stage == 1] == WIDEST
    assert [s.name for s in sites if s.stage == 2] == HALF


@pytest.mark.parametrize("h, w", [(1, 1), (1, 5), (2, 1), (2, 2), (3, 2), (7, 5), (8, 8), (13, 16)])
def test_filter_is_the_fourier_filter(h, w):
    x = torch.randn(2, 3, h, w, dtype=torch.float64, generator=torch.Generator().manual_seed(h * w))
    torch.testing.assert_close(filter_low_frequencies(x, 0.2), fourier(x, 0.2), rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_filter_in_half_precision_rounds_only_the_result(dtype):
    x = torch.randn(2, 3, 31, 17, generator=torch.Generator().manual_seed(0)).to(dtype)
    got = filter_low_frequencies(x, 0.2)
    assert got.dtype == dtype
    torch.testing.assert_close(got.double(), fourier(x, 0.2), rtol=torch.finfo(dtype).eps, atol=1e-6)


def test_paper_mode_edits_every_site_and_nothing_else():
    unet, seen = make_unet(), {}
    b, s = {1: 1.3, 2: 1.2}, {1: 0.9, 2: 0.2}

    def record(name, when):
        return lambda _, args: seen.setdefault(name, {}).__setitem__(when, args[0].clone())

    blocks = {name: m for name, m in unet.named_modules() if name.startswith("up_blocks") and hasattr(m, "conv1")}
    for name, block in blocks.items():
        block.register_forward_pre_hook(record(name, "before"))
    FreeU(unet, FreeUConfig("paper", b[1], b[2], s[1], s[2])).install()
    for name, block in blocks.items():
        block.register_forward_pre_hook(record(name, "after"))
    run(unet, 9, 7)

    sites = {site.name: site for site in freeu_sites(unet)}
    assert len(seen) == 12 and len(sites) == 10
    for name, x in seen.items():
        expected = x["before"].double()
        if name in sites:
            width, stage = sites[name].backbone, sites[name].stage
            expected[:, : width // 2] *= b[stage]
            expected[:, width:] = fourier(x["before"][:, width:], s[stage])
        torch.testing.assert_close(x["after"].double(), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("mode", ["paper", "diffusers"])
def test_factors_of_one_are_the_identity_to_the_bit(unet, mode):
    plain = run(unet, 9, 7)
    freeu = FreeU(unet, FreeUConfig(mode, 1, 1, 1, 1)).install()
    assert torch.equal(run(unet, 9, 7), plain)
    freeu.remove()


@pytest.mark.parametrize("mode", ["paper", "diffusers"])
def test_removal_leaves_no_trace(mode):
    unet = make_unet()
    plain, keys, hooks = run(unet), list(unet.state_dict()), count_hooks(unet)
    freeu = FreeU(unet, FreeUConfig(mode)).install()
    assert list(unet.state_dict()) == keys
    changed = run(unet)
    assert not torch.allclose(changed, plain, rtol=1e-3)
    assert torch.equal(run(unet), changed), "a second call sees the same factors, not their squares"
    assert torch.equal((freeu.install(), run(unet))[1], changed), "installing twice is installing once"
    freeu.remove()
    assert torch.equal(run(unet), plain)
    assert count_hooks(unet) == hooks and list(unet.state_dict()) == keys


def count_hooks(unet):
    return sum(len(m._forward_pre_hooks) + len(m._forward_hooks) for m in unet.modules())


def test_diffusers_mode_is_diffusers_own_and_another_set_of_sites(unet):
    config = FreeUConfig("diffusers")
    unet.enable_freeu(s1=0.9, s2=0.2, b1=1.1, b2=1.1)
    own = run(unet)
    unet.disable_freeu()
    results = {}
    for mode in ("diffusers", "paper"):
        freeu = FreeU(unet, FreeUConfig(mode)).install()
        results[mode] = run(unet)
        freeu.remove()
    assert (config.b1, config.b2, config.s1, config.s2) == (1.1, 1.1, 0.9, 0.2)
    assert torch.equal(results["diffusers"], own)
    assert not torch.allclose(results["paper"], own, rtol=1e-3)


def test_half_precision_and_odd_sizes_run_through_the_network():
    unet = make_unet().to(torch.bfloat16)
    FreeU(unet, FreeUConfig("paper")).install()
    out = run(unet, 9, 13, torch.bfloat16)
    assert out.dtype == torch.bfloat16 and out.isfinite().all() and out.shape == (2, 4, 9, 13)


def test_a_network_without_sites_is_refused():
    flat = make_unet(block_out_channels=(32, 32, 32, 32))
    with pytest.raises(PriorError, match=r"no decoder block.*b2 and s2.*freeu.b2=1"):
        FreeU(flat, FreeUConfig("paper"))
    FreeU(flat, FreeUConfig("paper", b2=1, s2=1))
    FreeU(flat, FreeUConfig("none"))


@pytest.mark.parametrize(
    "values, message",
    [
        ({"mode": "papre"}, "freeu.mode.*Did you mean 'paper'"),
        ({"b1": float("nan")}, "freeu.b1: got nan"),
        ({"s2": -0.1}, "freeu.s2: got -0.1"),
        ({"mode": "diffusers", "s2": 0.0}, "freeu.s2.*takes a factor of 0 for 'off'"),
    ],
)
def test_bad_settings_are_refused(values, message):
    with pytest.raises(ConfigError, match=message):
        parse(FreeUConfig, values, "freeu")
