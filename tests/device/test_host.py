"""The guidances for the host's systems, with the host's tensors and their own networks on a device that is not the
CPU's."""

from __future__ import annotations

import pytest
from dreamcatalyst.guidance.guidance import Guidance
from dreamcatalyst.host import guidance as host

from tests.device.far import FAR, Far, install
from tests.diffusion.small_model import make_model
from tests.test_host_guidance import WORDS, Processor, loss_of, made, picture

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    root = tmp_path_factory.mktemp("models")
    return {"ip2p": make_model(root / "ip2p"), "sd": make_model(root / "sd", channels=4)}


@pytest.fixture
def device(monkeypatch):
    found = install(monkeypatch)
    monkeypatch.setattr(host, "Guidance", lambda *settings: Guidance(*settings[:-1], FAR))  # where the host puts us
    with found:
        yield found


def far_words() -> Processor:
    words = Processor()
    words.text, words.null = words.text.to(FAR), words.null.to(FAR)
    return words


@pytest.mark.parametrize("prior", ["ip2p", "sd"])
def test_the_loss(device, models, prior):
    rule = {"ip2p": "dreamcatalyst", "sd": "sds"}[prior]
    guidance = made("guidance", prior_type=prior, prior={"path": str(models[prior]), "dtype": "fp16"}, rule=rule)
    rgb, source = picture(64, 64, seed=1).to(FAR), picture(64, 64).to(FAR)
    out, gradient = loss_of(guidance, rgb, *([source] if prior == "ip2p" else []), far_words())
    assert isinstance(out["loss_sds"], Far) and isinstance(gradient, Far)
    assert gradient.cpu().isfinite().all() and gradient.cpu().any()


def test_the_edited_picture(device, models):
    guidance = made("edit-guidance", prior_type="ip2p", prior={"path": str(models["ip2p"])}, rule="in2n",
                    diffusion_steps=2, prompt=WORDS)  # fmt: skip
    out = guidance(picture(64, 64, seed=1).to(FAR), picture(64, 64).to(FAR), far_words())
    assert isinstance(out["edit_images"], Far) and out["edit_images"].shape == (1, 64, 64, 3)
