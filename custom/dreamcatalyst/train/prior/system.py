"""Training a small InstructPix2Pix: first the autoencoder on crops, then text encoder and U-Net on its latents."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ... import plugin
from ...config import Seed
from ...diffusion.ip2p import InstructPix2Pix, Ip2pConfig
from ...diffusion.noise import keyed_generator, stable_diffusion_schedule
from ...errors import ConfigError, DataError, NumericalError
from ...report.pictures import write_png
from ..base import System
from .data import PriorData
from .folder import write_prior
from .judge import SamplesConfig, edit_rows, judge_pairs, reconstruction_rows, score_table, sheet
from .latents import cached_latents
from .losses import reconstruction_loss, unet_loss
from .models import TIMESTEPS, AutoencoderConfig, Networks, TextConfig, UnetConfig, make_networks
from .stages import STAGES, Progress, cosine, unet_inputs
from .vocabulary import Tokens, learn_merges, unknown_words, vocabulary

CLIP = 1.0  # largest norm of a gradient


@plugin.register("dreamcatalyst-prior-system")
class PriorSystem(System):
    """Trains in two stages; `ema` holds the weights that are kept, and is what is sampled, encoded with and written.

    What a step draws is a function of the seed and its number, so that a resumed run has the bits of an uninterrupted
    one (unless a stage is ended by minutes).
    """

    @dataclass(frozen=True)
    class Parts:
        """The parsed sections."""

        autoencoder: AutoencoderConfig
        text: TextConfig
        unet: UnetConfig
        samples: SamplesConfig

    part: Parts
    networks: Networks  # from `setup` on, as is `ema`
    ema: Networks
    latents: Mapping[str, Tensor]  # of all pairs, in the second stage

    @dataclass
    class Config(System.Config):
        seed: Seed = 0
        autoencoder: dict = field(default_factory=dict)
        text: dict = field(default_factory=dict)
        unet: dict = field(default_factory=dict)
        samples: dict = field(default_factory=dict)

    def of(self, stage: str) -> AutoencoderConfig | UnetConfig:
        """The section of a stage."""
        return getattr(self.part, stage)

    # --- setting up

    def configure(self) -> None:
        super().configure()
        self.progress = {name: Progress() for name in STAGES}
        self._loss: float | None = None  # smoothed
        self._workers: ThreadPoolExecutor | None = None
        self._outcomes: list[dict[str, Any]] = []

    def setup(self, stage: str) -> None:
        if hasattr(self, "networks"):
            return
        self._make_networks(learn_merges(self.data.pairs.instruction))
        self.register_buffer("latent_std", torch.ones(()))
        self.abar = stable_diffusion_schedule(TIMESTEPS).float()

    def _make_networks(self, merges: list[tuple[str, str]]) -> None:
        """Networks that have learned nothing, for the vocabulary of `merges`."""
        part, self.merges = self.part, merges
        size, tokens = self.data.cfg.size, len(vocabulary(merges))
        self.networks = make_networks(part.autoencoder, part.text, part.unet, size, tokens, self.cfg.seed)
        self.ema = copy.deepcopy(self.networks)
        for name, kept in self.ema.items():
            self.networks[name].to(memory_format=torch.channels_last)
            kept.requires_grad_(False).to(memory_format=torch.channels_last)

    @cached_property
    def token_ids(self) -> Tokens:
        """The tokenizer that is written with the model."""
        return Tokens(self.path("prior") / "tokenizer", self.merges, self.part.text.tokens)

    @property
    def data(self) -> PriorData:
        return self.trainer.datamodule

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        return [
            torch.optim.AdamW(self.trained(name), self.of(name).learning_rate, betas=(0.9, 0.99), weight_decay=0.01)
            for name in STAGES
        ]

    # --- training

    @property
    def stage(self) -> str:
        return "autoencoder" if self.progress["unet"].first is None else "unet"

    def on_train_start(self) -> None:
        if self.progress["autoencoder"].first is None:
            self.progress["autoencoder"].first = self.true_global_step
        if self.stage == "unet":
            self._load_latents()

    def training_step(self, batch: Mapping[str, int], batch_idx: int) -> None:
        started = time.perf_counter()
        stage, step = self.stage, batch["step"]
        config, progress = self.of(stage), self.progress[stage]
        done = progress.at(step, config)
        number = progress.steps(step)
        optimizer = self.optimizers()[list(STAGES).index(stage)]
        rate = config.learning_rate * min(1.0, (number + 1) / max(config.warm_up, 1)) * cosine(done)
        for group in optimizer.param_groups:
            group["lr"] = rate
        optimizer.zero_grad()
        value = self._autoencoder_gradients(number, done) if stage == "autoencoder" else self._unet_gradients(number)
        if not math.isfinite(value):
            raise NumericalError(f"step {step}, stage {stage}: the loss is {value}. Lower its learning_rate.")
        parameters = self.trained(stage)
        nn.utils.clip_grad_norm_(parameters, CLIP)
        optimizer.step()
        kept = [p for name in STAGES[stage] for p in self.ema[name].parameters()]
        with torch.no_grad():
            torch._foreach_lerp_(kept, parameters, 1 - min(config.ema, (number + 1) / (number + 10)))
        self.log("loss", value)
        self._loss = value if self._loss is None else 0.98 * self._loss + 0.02 * value
        progress.seconds += time.perf_counter() - started

    def trained(self, stage: str) -> list[Tensor]:
        """What trains in a stage."""
        return [p for name in STAGES[stage] for p in self.networks[name].parameters()]

    def _autoencoder_gradients(self, number: int, done: float) -> float:
        """The loss of one step, its gradients left in the parameters."""
        config: AutoencoderConfig = self.part.autoencoder
        side, size = config.crop, config.batch_size
        if done >= 1 - config.whole:
            side, size = self.data.cfg.size, max(1, round(size * (config.crop / self.data.cfg.size) ** 2))
        images = self.data.crops(number, size, side).to(self.device, memory_format=torch.channels_last) * 2 - 1
        posterior = self.networks["vae"].encode(images).latent_dist
        noise = torch.randn(posterior.mean.shape, generator=keyed_generator(self.cfg.seed, "posterior", number))
        made = self.networks["vae"].decode(posterior.mean + posterior.std * noise.to(images)).sample
        divergence = 0.5 * (posterior.mean**2 + posterior.var - 1 - posterior.logvar).mean()
        loss = reconstruction_loss(made, images, config.gradients) + config.kl * divergence
        self.manual_backward(loss)
        return float(loss.detach())

    def _unet_gradients(self, number: int) -> float:
        """The loss of one step, its gradients left in the parameters.

        On a CPU every thread takes its own rows of the batch all the way: threads that wait for each other once a step,
        and not within every operation, keep their speed where cores are shared.
        """
        size = self.part.unet.batch_size
        data, config, seed = self.data, self.part.unet, self.cfg.seed
        index = data.batch(number, size)
        inputs = unet_inputs(data.pairs, index, self.latents, self.latent_std, self.token_ids, config, seed, number)
        drawn = [tensor.to(self.device) for tensor in inputs]
        threads = min(torch.get_num_threads(), size) if self.device.type == "cpu" else 1
        if threads == 1:
            loss = unet_loss(self.networks, self.abar, drawn, slice(0, size))
            self.manual_backward(loss)
            return float(loss.detach())
        parameters, ends = self.trained("unet"), [size * i // threads for i in range(threads + 1)]

        def part(rows: slice) -> tuple[Tensor, Sequence[Tensor | None]]:
            with torch.enable_grad():
                loss = unet_loss(self.networks, self.abar, drawn, rows)
                return loss.detach(), torch.autograd.grad(loss, parameters, allow_unused=True)

        if self._workers is None:
            self._workers = ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,))
        losses, gradients = zip(*self._workers.map(part, map(slice, ends, ends[1:])), strict=True)
        for parameter, *parts in zip(parameters, *gradients, strict=True):
            parameter.grad = None if parts[0] is None else sum(parts)
        return float(sum(losses))

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        super().on_train_batch_end(outputs, batch, batch_idx)
        step, stage, every = self.true_global_step, self.stage, self.part.samples.every
        over = self.progress[stage].at(step, self.of(stage)) >= 1
        if over or (every and step % every == 0):
            self.write_pictures(step)
        if over and stage == "autoencoder":
            self._begin_unet(step)
        elif over:
            self.trainer.should_stop = True

    def _begin_unet(self, step: int) -> None:
        """Encode all pairs with the finished autoencoder."""
        self.progress["unet"].first, self._loss = step, None
        self._load_latents()
        self.latent_std.copy_(self.latents["edited"].float().std())
        plugin.info(f"autoencoder done at step {step}; standard deviation of its latents {float(self.latent_std):.4f}")

    def _load_latents(self) -> None:
        self.ema["vae"].to(self.device)
        self.latents = cached_latents(self.path("latents.pt"), self.ema["vae"], self.data.pairs, self.device)

    def progress_metrics(self) -> dict[str, Any]:
        stage = self.stage
        share = self.progress[stage].at(self.true_global_step, self.of(stage))
        shown = {"stage": stage, "of it": f"{share:.0%}", "minutes": self.progress[stage].seconds / 60}
        return shown if self._loss is None else {**shown, "loss": self._loss}

    def on_train_end(self) -> None:
        self.write_folder()
        self.save_now()  # ended by minutes or trainer.max_time, it is at no step that the checkpoints' interval hits

    # --- looking

    def write_pictures(self, step: int) -> None:
        """Some held-out pairs: what the autoencoder makes of them or, in the second stage, the edits of the moment."""
        index = self.data.held_out_spread(self.part.samples.pictures)
        if self.stage == "autoencoder":
            rows, decibel = reconstruction_rows(self.ema["vae"], self.data.pairs, index, self.device)
        else:
            judged = self._judge(self.prior(), index)
            rows, decibel = edit_rows(judged), float(judged["edit_inside"].nanmean())
        write_png(self.path(f"it{step}-{self.stage}.png"), sheet(rows))
        plugin.info(f"step {step}, {self.stage}: {decibel:.2f} dB on held-out pairs")

    def _judge(self, prior: InstructPix2Pix, index: np.ndarray | list[int]) -> dict[str, Any]:
        return judge_pairs(prior, self.data.pairs, index, self.part.samples, self.cfg.seed)

    def on_test_start(self) -> None:
        self._prior = self.prior()

    def test_step(self, batch: Mapping[str, list[int]], batch_idx: int) -> None:
        self._outcomes.append(self._judge(self._prior, batch["index"]))

    def on_test_epoch_end(self) -> None:
        print(f"held-out pairs, PSNR in dB:\n{score_table(self._outcomes)}", flush=True)
        rows = [row for judged in self._outcomes for row in edit_rows(judged)]
        write_png(self.path(f"it{self.true_global_step}-test.png"), sheet(rows))
        plugin.info(f"the model: {self.path('prior')}")
        self._outcomes = []

    on_validation_start, validation_step, on_validation_epoch_end = on_test_start, test_step, on_test_epoch_end

    def predict_step(self, batch: Mapping[str, list[int]], batch_idx: int) -> None:
        """Export needs no pair."""

    def on_predict_epoch_end(self) -> None:
        plugin.info(f"exported to {self.write_folder()}")

    # --- files and checkpoints

    def path(self, name: str) -> Path:
        """A file under the run's save folder."""
        return Path(self.get_save_path(name))

    def prior(self) -> InstructPix2Pix:
        """The kept weights, written and loaded again as any user of them would."""
        return InstructPix2Pix(Ip2pConfig(path=str(self.write_folder())), self.device)

    def write_folder(self) -> Path:
        """Write the model of the moment under the run's save folder."""
        data, ends = self.data, {"autoencoder": self.progress["unet"].first, "unet": None}
        done = {name: self.progress[name].steps(self.true_global_step, end) for name, end in ends.items()}
        card = {"pairs": len(data.train), "origin": data.origin, **done}
        return write_prior(self.path("prior"), self.ema, self.merges, float(self.latent_std), data.pairs.wordings, card)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        progress = {name: asdict(progress) for name, progress in self.progress.items()}
        checkpoint["prior"] = {"progress": progress, "merges": self.merges, "loss": self._loss}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        if "prior" not in checkpoint:
            raise ConfigError("resume: the checkpoint is of another kind of run, expected one of configs/prior.yaml.")
        state, texts = checkpoint["prior"], self.data.pairs.instruction
        unknown = unknown_words(texts, state["merges"])
        if unknown:
            raise DataError(
                f"resume: {self.data.folder} has other instructions than those of the checkpoint, whose words are the "
                f"text encoder's tokens: '{unknown[0]}' is none. Name the pairs that it was trained on: data.pairs=..."
            )
        if state["merges"] != self.merges:  # learned by another version
            self._make_networks(state["merges"])
        self.progress = {name: Progress(**progress) for name, progress in state["progress"].items()}
        self._loss = state["loss"]
