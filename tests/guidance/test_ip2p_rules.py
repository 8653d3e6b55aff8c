"""Each rule through InstructPix2Pix against a plain transcription of its paper's equations: the models of diffusers,
one call for every row, nothing shared, nothing left out."""

from __future__ import annotations

import math

import pytest
import torch
from dreamcatalyst.diffusion.noise import keyed_noise
from dreamcatalyst.guidance.config import GuidanceConfig
from dreamcatalyst.guidance.guidance import Guidance

from tests.diffusion.small_model import make_model

PROMPT, SOURCE_PROMPT = "make it snow", "photo of the fox"
W_Y, W_I, SEED, VIEW, STEPS = 7.5, 1.5, 3, 5, 50


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_model(tmp_path_factory.mktemp("models") / "ip2p")


def test_independent_latents_are_drawn_anew_at_every_step_source_and_edit_apart(folder, monkeypatch):
    """As the published codes draw them; a function of seed, step and view, so that a resumed run draws the same."""
    from dreamcatalyst.guidance import distillation as module

    prior = {"path": str(folder), "latents": "independent"}
    made = Guidance(GuidanceConfig(prior_type="ip2p", prior=prior, seed=SEED), PROMPT)
    image, seen = torch.rand(1, 40, 32, 3, generator=torch.Generator().manual_seed(1)), {}

    def gradient(prior, rule, x, x_src, **others):
        seen[step] = [(z - mode) / deviation for z in (x, x_src)]
        return torch.zeros_like(x)

    monkeypatch.setattr(module, "distillation_gradient", gradient)
    pixels = image.permute(0, 3, 1, 2)
    mode, deviation = made.prior.encode(pixels), made.prior.deviation(pixels)
    for step in (*range(30), 0):
        before = seen.get(step)
        made.step(image, image, [VIEW], step, 100)
        if before is not None:
            assert all(torch.equal(one, other) for one, other in zip(before, seen[step], strict=True))
    edited, source = (torch.cat(draws).flatten(1) for draws in zip(*seen.values(), strict=True))
    assert edited.std().item() == pytest.approx(1, abs=0.06) and source.std().item() == pytest.approx(1, abs=0.06)
    both = torch.corrcoef(torch.stack([edited.flatten(), source.flatten(), edited.roll(1, 0).flatten()]))
    assert (both - torch.eye(3)).abs().max() < 0.1


@pytest.fixture(scope="module")
def pipeline(folder):
    from diffusers import StableDiffusionInstructPix2PixPipeline

    return StableDiffusionInstructPix2PixPipeline.from_pretrained(folder)


class Transcription:
    """The papers' symbols: e(x_t; y, I) of the U-Net, z_t, abar, and guided predictions as sums of three."""

    def __init__(self, pipeline, source: torch.Tensor):
        self.pipeline, self.vae = pipeline, pipeline.vae
        betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
        self.alpha, self.abar = 1 - betas, torch.cumprod(1 - betas, 0)
        image = 2 * source.permute(0, 3, 1, 2) - 1
        with torch.no_grad():
            self.condition = self.vae.encode(image).latent_dist.mode()  # Brooks et al. 2023: not scaled
            self.x_src = self.condition * 0.18215

    def text(self, words):
        ids = self.pipeline.tokenizer(words, padding="max_length", max_length=77, truncation=True, return_tensors="pt")
        with torch.no_grad():
            return self.pipeline.text_encoder(ids.input_ids)[0]

    def noised(self, x, noise, t):
        return float(self.abar[t].sqrt()) * x + float((1 - self.abar[t]).sqrt()) * noise

    def e(self, noisy, words, image: bool):
        condition = self.condition if image else torch.zeros_like(self.condition)
        with torch.no_grad():
            return self.pipeline.unet(torch.cat([noisy, condition], 1), self.t, self.text(words)).sample

    def guided(self, noisy, words, w_y=W_Y):
        null, image, full = self.e(noisy, "", False), self.e(noisy, "", True), self.e(noisy, words, True)
        return null + w_y * (full - image) + W_I * (image - null)


def gradient(p: Transcription, rule: str, x, noise, t: int):
    """g of each rule as its paper states it."""
    p.t = t
    u = (t - 1) / 1000
    x_t, source_t = p.noised(x, noise, t), p.noised(p.x_src, noise, t)
    phi = 0.075 * math.exp(u)
    if rule == "sds":  # w(t) (e - noise), w = 1 - abar
        return float(1 - p.abar[t]) * (p.guided(x_t, PROMPT) - noise)
    if rule == "dds":
        return p.guided(x_t, PROMPT) - p.guided(source_t, SOURCE_PROMPT)
    if rule == "pds":  # z_t(x) - z_t(x_src), z_t = (x_{t-gap} - mu(x_t, e)) / sigma, the same further noise in both
        earlier, beta = p.abar[t - 2], 1 - p.alpha[t]
        sigma = (beta * (1 - earlier) / (1 - p.abar[t])).sqrt()

        def z(x0, e):
            noisy, e = p.noised(x0.double(), noise.double(), t), e.double()
            x0_hat = (noisy - (1 - p.abar[t]).sqrt() * e) / p.abar[t].sqrt()
            mu = earlier.sqrt() * beta / (1 - p.abar[t]) * x0_hat
            mu = mu + p.alpha[t].sqrt() * (1 - earlier) / (1 - p.abar[t]) * noisy
            return (earlier.sqrt() * x0.double() - mu) / sigma

        return (z(x, p.guided(x_t, PROMPT)) - z(p.x_src, p.guided(source_t, SOURCE_PROMPT))).float()
    if rule == "csd-like":
        return phi * (x - p.x_src) + psi(rule, u) * (p.guided(x_t, PROMPT) - p.guided(x_t, PROMPT, w_y=0.0))
    return phi * (x - p.x_src) + psi(rule, u) * (p.guided(x_t, PROMPT) - p.guided(source_t, PROMPT, w_y=0.0))


def psi(rule: str, u: float) -> float:
    return {"dreamcatalyst-psi2": 1.0, "dreamcatalyst-psi3": 1 - 0.2 * u}.get(rule, 0.2 + 0.8 * u ** (1 / math.e))


RULES = ["sds", "dds", "pds", "dreamcatalyst", "dreamcatalyst-psi2", "dreamcatalyst-psi3", "csd-like"]


@pytest.mark.parametrize("rule", RULES)
def test_a_rule_gives_the_gradient_of_its_papers_equations(rule, folder, pipeline):
    config = GuidanceConfig(prior_type="ip2p", prior={"path": str(folder)}, rule=rule, seed=SEED)
    guidance = Guidance(config, PROMPT, SOURCE_PROMPT)
    generator = torch.Generator().manual_seed(0)
    source, rgb = (torch.rand(1, 64, 64, 3, generator=generator) for _ in range(2))
    plain = Transcription(pipeline, source)
    for step in (0, STEPS - 1):
        ours = rgb.clone().requires_grad_()
        given = guidance.step(ours, source, [VIEW], step, STEPS)
        given.loss.backward()

        theirs = rgb.clone().requires_grad_()
        x = plain.vae.encode(2 * theirs.permute(0, 3, 1, 2) - 1).latent_dist.mode() * 0.18215
        noise = keyed_noise(SEED, step, VIEW, x.shape[1:])[None]
        wanted = gradient(plain, rule, x.detach(), noise, given.timestep)
        (0.5 * (x - (x - wanted).detach()).square().mean()).backward()

        torch.testing.assert_close(given.gradient, wanted, rtol=1e-4, atol=1e-4 * float(wanted.abs().max()))
        torch.testing.assert_close(ours.grad, theirs.grad, rtol=1e-3, atol=1e-3 * float(theirs.grad.abs().max()))
