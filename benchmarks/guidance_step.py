"""Time and memory of one guidance step, rule by rule, beside a plain transcription of the published codes.

python benchmarks/guidance_step.py                            a small model at 64 x 64: seconds
python benchmarks/guidance_step.py --size sd15 --pixels 256 --repeats 1     Stable Diffusion 1.5's size: about 15 GB
python benchmarks/guidance_step.py --size sd15 --pixels 512 --plain-pixels 256 --repeats 1
python benchmarks/guidance_step.py --size sd15 --pixels 512 --device cuda --dtype fp16 --repeats 10

Weights are random and made on the spot. A step is from the render to the gradient on its pixels; the renderer is not in
it. Memory is what is allocated at most during a step beyond what was there before it (weights, cached conditions). The
first step is the one whose memory is counted; it warms up those that are timed.
"""

from __future__ import annotations

import argparse
import copy
import gc
import itertools
import sys
import tempfile
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "custom")]

from dreamcatalyst.cache import ByteCache  # noqa: E402
from dreamcatalyst.diffusion.api import Prior, Row  # noqa: E402
from dreamcatalyst.diffusion.autoencoder import Autoencoder, load_autoencoder  # noqa: E402
from dreamcatalyst.diffusion.folder import open_folder  # noqa: E402
from dreamcatalyst.diffusion.noise import abar_at, add_noise  # noqa: E402
from dreamcatalyst.guidance.config import GuidanceConfig, chosen_rule, chosen_schedule  # noqa: E402
from dreamcatalyst.guidance.guidance import Guidance  # noqa: E402
from dreamcatalyst.guidance.prompted import VIEW_BYTES  # noqa: E402

from tests.diffusion.small_model import FULL, SMALL, make_model, make_tiny_autoencoder  # noqa: E402

RULES = ("sds", "dds", "pds", "dreamcatalyst", "csd-like")
OPTIONS = ("slicing", "tiling", "channels_last", "offload", "compile")  # of the prior, for --options
STAGES = ("encode", "U-Net", "backward")
DTYPES = {"fp32": torch.float32, "fp16": torch.float16, "bf16": torch.bfloat16}
PROMPT, VIEW, LENGTH = "make it snow", 0, 100


class Clock:
    """Seconds and U-Net rows of the stages of a step, waiting for the device at each border."""

    def __init__(self, device: torch.device):
        self.cuda = device.type == "cuda"
        self.seconds: dict[str, float] = defaultdict(float)
        self.rows = 0

    def now(self) -> float:
        if self.cuda:
            torch.cuda.synchronize()
        return time.perf_counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = self.now()
        yield
        self.seconds[name] += self.now() - start

    @contextmanager
    def watching(self, prior: Prior) -> Iterator[None]:
        """Time what `prior` encodes and predicts inside."""
        encode, predict = prior.encode, prior.predict_noise

        def timed_encode(images: Tensor) -> Tensor:
            with self.stage("encode"):
                return encode(images)

        def timed_predict(rows: list[Row], timestep: int) -> list[Tensor]:
            self.rows += sum(len(row.noisy) for row in rows)
            with self.stage("U-Net"):
                return predict(rows, timestep)

        prior.encode, prior.predict_noise = timed_encode, timed_predict
        yield
        del prior.encode, prior.predict_noise  # the class's own are seen again


def make_guidance(folder: Path, args: argparse.Namespace, **prior: Any) -> Guidance:
    options = {"path": str(folder), "dtype": args.dtype, **prior}
    config = GuidanceConfig(prior_type="ip2p", prior=options, reduction="sum")
    return Guidance(config, PROMPT, device=args.device)


def with_rule(guidance: Guidance, rule: str) -> Guidance:
    """The same prior under another rule."""
    other = copy.copy(guidance)
    other.config = replace(guidance.config, rule=rule)
    other.rule = chosen_rule(other.config)
    other.schedule = chosen_schedule(other.config, other.rule)
    other.objective = other.begin(other.rule)
    return other


def with_prior(guidance: Guidance, **changes: Any) -> Guidance:
    """The same U-Net behind an autoencoder of its own. changes: max_rows, autoencoder, checkpointing of the prior."""
    other, prior = copy.copy(guidance), copy.copy(guidance.prior)
    other.prior, other._views = prior, ByteCache(VIEW_BYTES)
    prior.config = replace(prior.config, **changes)
    prior.max_rows = prior.config.max_rows
    folder = open_folder(prior.config.path, conditioned=True)
    vae = load_autoencoder(folder, prior.config.autoencoder, prior.dtype).to(prior.device)
    prior.autoencoder = Autoencoder(vae, folder)
    if prior.config.checkpointing:
        prior.autoencoder.enable_checkpointing()
    other.objective = other.begin(other.rule)
    return other


def our_step(guidance: Guidance, clock: Clock, rgb: Tensor, source: Tensor, step: int = 10) -> Tensor:
    """The gradient on the latents; that on the pixels is left in rgb.grad."""
    given = guidance.step(rgb, source, [VIEW], step, LENGTH)
    with clock.stage("backward"):
        given.loss.backward()
    return given.gradient


def plain_step(
    guidance: Guidance, clock: Clock, rgb: Tensor, source: Tensor, *, graph: bool, again: bool, step: int = 10
) -> Tensor:
    """DreamCatalyst's rule written down as published: every row, one call for each branch.

    graph: keep the autograd graph through the U-Net, and throw it away. again: encode source and condition each step.
    """
    prior, (w_y, w_i) = guidance.prior, guidance.scales
    vae, unet, dtype, scale = prior.autoencoder.vae, prior.unet, prior.dtype, prior.autoencoder.scale
    images, originals = (2 * each.permute(0, 3, 1, 2).to(dtype) - 1 for each in (rgb, source))
    with clock.stage("encode"):
        x = vae.encode(images).latent_dist.mode().float() * scale
        if again:
            guidance._views.clear()
        x_src, condition = guidance._views.get(
            VIEW,
            lambda: (
                vae.encode(originals).latent_dist.mode().float() * scale,
                vae.encode(originals).latent_dist.mode(),
            ),
        )
    timestep = guidance.schedule.timestep(step, LENGTH, prior.alphas_cumprod)
    noise, abar = guidance.noise(x, [VIEW], step), abar_at(prior.alphas_cumprod, timestep)
    null = prior.embed([""])[0]
    text = torch.stack([guidance.text, null, null])
    image = torch.cat([condition, condition, torch.zeros_like(condition)])
    predictions = []
    with nullcontext() if graph else torch.no_grad(), clock.stage("U-Net"):
        for noisy, scale_y in ((add_noise(x, noise, abar), w_y), (add_noise(x_src, noise, abar), 0.0)):
            inputs = torch.cat([noisy.to(dtype).expand(3, -1, -1, -1), image], dim=1)
            full, half, none = unet(inputs, timestep, encoder_hidden_states=text).sample.float().chunk(3)
            predictions.append(none + scale_y * (full - half) + w_i * (half - none))
    clock.rows += 6
    a, b = guidance.rule.weights(timestep, prior.alphas_cumprod)
    gradient = (a * (predictions[0] - predictions[1]) + b * (x - x_src)).detach()
    loss = 0.5 * (x - (x - gradient).detach()).square().sum()
    with clock.stage("backward"):
        loss.backward()
    return gradient


def picture(pixels: int, args: argparse.Namespace, seed: int) -> Tensor:
    return torch.rand(1, pixels, pixels, 3, generator=torch.Generator().manual_seed(seed)).to(args.device)


def measure(step: Callable[..., Tensor], source: Tensor, args: argparse.Namespace, watch: Prior | None = None) -> dict:
    """The peak of the first step in MiB, and of the next ones the fastest's seconds by stage and in all, and its rows.

    step(clock, rgb, source), which leaves the gradient in rgb.grad.
    """
    device, render = source.device, picture(source.shape[1], args, seed=1)
    rgb = render.clone().requires_grad_()
    memory = peak(lambda: step(Clock(device), rgb, source), device) / 2**20
    clock, runs = Clock(device), []
    with clock.watching(watch) if watch is not None else nullcontext():
        for _ in range(args.repeats):
            clock.seconds.clear()
            clock.rows = 0
            rgb, start = render.clone().requires_grad_(), clock.now()
            step(clock, rgb, source)
            runs.append({"all": clock.now() - start, **clock.seconds})
    return {"rows": clock.rows, **min(runs, key=lambda run: run["all"]), "memory": memory, "grad": rgb.grad}


def measure_ours(guidance: Guidance, source: Tensor, args: argparse.Namespace) -> dict:
    guidance.encode_source(source[0], VIEW)  # source and condition are encoded once, not in each step
    return measure(partial(our_step, guidance), source, args, watch=guidance.prior)


def peak(action: Callable[[], Any], device: torch.device) -> int:
    """Bytes that `action` has allocated at most, beyond what was allocated before it."""
    if device.type == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        action()
        torch.cuda.synchronize()
        return torch.cuda.max_memory_allocated() - before
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as profile:
        action()
    memory = (e for e in profile.profiler.kineto_results.events() if e.name() == "[memory]")
    return max(itertools.accumulate((e.nbytes() for e in sorted(memory, key=lambda e: e.start_ns())), initial=0))


def bare_call(guidance: Guidance, rows: int, args: argparse.Namespace) -> float:
    """Seconds of one U-Net call of so many rows and nothing else, at the pixels of the table of rules."""
    prior, side, clock = guidance.prior, args.pixels // 8, Clock(torch.device(args.device))
    inputs = torch.randn(rows, 8, side, side, device=args.device, dtype=prior.dtype)
    text = guidance.text.expand(rows, -1, -1)
    times = []
    with torch.no_grad():
        for _ in range(args.repeats):
            start = clock.now()
            prior.unet(inputs, 500, encoder_hidden_states=text)
            times.append(clock.now() - start)
    return min(times)


def line(name: str, got: dict, *more: str) -> None:
    rest = got["all"] - sum(got[stage] for stage in STAGES)
    numbers = [f"{1e3 * got[stage]:9.1f}" for stage in STAGES] + [f"{1e3 * rest:7.1f}", f"{1e3 * got['all']:9.1f}"]
    print(f"{name:46s}{got['rows']:5d} {' '.join(numbers)} {got['memory']:10.1f}", *more, flush=True)


def heading(title: str, *more: str) -> None:
    columns = [f"{name:>9s}" for name in STAGES] + [f"{'rest':>7s}", f"{'all, ms':>9s}", f"{'peak, MiB':>10s}", *more]
    print(f"\n{title:46s} rows {' '.join(columns)}")


def rules_table(guidance: Guidance, args: argparse.Namespace) -> None:
    heading(f"rule, {args.pixels} x {args.pixels}", "  of a bare call of these rows")
    bare = cache(lambda rows: bare_call(guidance, rows, args))
    for rule in args.rules:
        got = measure_ours(with_rule(guidance, rule), picture(args.pixels, args, seed=0), args)
        line(rule, got, f"{got['all'] / bare(got['rows']):9.2f}")


def savings_table(guidance: Guidance, folder: Path, tiny: Path, args: argparse.Namespace) -> None:
    side = args.plain_pixels or args.pixels
    heading(f"dreamcatalyst, {side} x {side}", "    time  memory, of the first line")
    guidance, source = with_prior(guidance), picture(side, args, seed=0)
    plain = {
        "plain: 3 + 3 rows, graph, encodes all": dict(graph=True, again=True),
        "  without graph through the U-Net": dict(graph=False, again=True),
        "  and source, condition encoded once": dict(graph=False, again=False),
    }
    changes = {
        "  and one call of 3 + 2 rows: ours": {},
        "ours, rows one at a time": {"max_rows": 1},
        "ours, encoder checkpointed": {"checkpointing": True},
        "ours, tiny autoencoder (TAESD)": {"autoencoder": str(tiny)},
    }
    if args.short:
        plain, changes = (dict(itertools.islice(each.items(), 1)) for each in (plain, changes))
    results = {}

    def show(name: str, got: dict) -> None:
        results[name] = got
        first = next(iter(results.values()))
        line(name, got, f"{got['all'] / first['all']:7.3f} {got['memory'] / first['memory']:7.3f}")

    for name, flags in plain.items():
        show(name, measure(partial(plain_step, guidance, **flags), source, args))
    for name, changed in changes.items():
        show(name, measure_ours(with_prior(guidance, **changed), source, args))
    for option in args.options:
        show(f"ours, {option}", measure_ours(make_guidance(folder, args, **{option: True}), source, args))
        gc.collect()  # a model has cycles, and the next one should not have to fit beside it
    (_, theirs), ours = next(iter(results.items())), results["  and one call of 3 + 2 rows: ours"]
    error = float((ours["grad"] - theirs["grad"]).abs().max() / theirs["grad"].abs().max())
    print(f"largest difference of the gradients on the pixels, plain and ours: {error:.1e} of the largest")
    faster, smaller = theirs["all"] / ours["all"], ours["memory"] / theirs["memory"]
    print(f"ours, {side} x {side}: {faster:.2f} times as fast as plain, {smaller:.3f} of its memory above the weights")


def quiet() -> None:
    """Random weights give the libraries something to remark on."""
    import diffusers
    import transformers

    warnings.filterwarnings("ignore")
    for library in (diffusers, transformers):
        library.utils.logging.set_verbosity_error()
        library.utils.logging.disable_progress_bar()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", choices=("small", "sd15"), default="small")
    parser.add_argument("--pixels", type=int, default=64, help="side of the picture, a multiple of 8")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--dtype", choices=DTYPES, default="fp32")
    parser.add_argument("--repeats", type=int, default=5, help="steps, of which the fastest counts")
    parser.add_argument("--plain-pixels", type=int, help="side for the comparison with plain, if other")
    parser.add_argument("--rules", nargs="*", choices=RULES, default=RULES)
    parser.add_argument("--short", action="store_true", help="of the comparison, plain and ours only")
    parser.add_argument("--options", nargs="*", choices=OPTIONS, default=(), help="of the prior, to compare")
    args = parser.parse_args()
    quiet()
    with tempfile.TemporaryDirectory() as made:
        folder = make_model(Path(made) / "ip2p", size=FULL if args.size == "sd15" else SMALL, dtype=DTYPES[args.dtype])
        wide = {"width": 64, "blocks": 3} if args.size == "sd15" else {}
        tiny = make_tiny_autoencoder(Path(made) / "tiny", **wide)
        print(f"{args.size} model, {args.dtype}, {args.device}", end="")
        gc.collect()  # the model that was written
        print(f", {torch.get_num_threads()} threads" if args.device == "cpu" else f": {torch.cuda.get_device_name()}")
        guidance = make_guidance(folder, args)
        rules_table(guidance, args)
        savings_table(guidance, folder, tiny, args)


if __name__ == "__main__":
    main()
