"""The pairs that a prior is trained on: made once, read once, and drawn as a function of seed and step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, IterableDataset

from ... import plugin
from ...config import AtLeastOne, Seed, Side, parse
from ...data.views import views_for_step
from ...demo.pairs import Operators, make_pairs, read_pairs
from ...demo.photographs import PHOTOGRAPHS
from ...diffusion.operators import find_operator
from ...errors import ConfigError, DataError

FEW = 16  # pairs that a trial of one step (trainer.fast_dev_run) makes for itself
Index = np.ndarray | list[int] | slice


class Pairs:
    """Pairs as arrays: source, edited uint8 [n,H,W,3]; mask uint8 [n,H,W]; instruction, edit [n] strings; world [n]."""

    def __init__(self, arrays: Mapping[str, np.ndarray]):
        self.arrays = arrays
        self.instruction, self.edit, self.world = (arrays[key] for key in ("instruction", "edit", "world"))

    def __len__(self) -> int:
        return len(self.instruction)

    @property
    def wordings(self) -> dict[str, list[str]]:
        """The instructions of each edit, in lower case and without a full stop."""
        found: dict[str, set[str]] = {}
        for edit, text in zip(self.edit.tolist(), self.instruction.tolist(), strict=True):
            found.setdefault(edit, set()).add(text.lower().rstrip("."))
        return {edit: sorted(texts) for edit, texts in sorted(found.items())}

    def images(self, kind: str, index: Index) -> Tensor:
        """Images of pairs, [B,3,H,W] in [0,1]. kind: source or edited."""
        return torch.from_numpy(self.arrays[kind][index]).permute(0, 3, 1, 2).float() / 255

    def masks(self, index: Index) -> Tensor:
        """Where pairs show what is edited, [B,1,H,W] in [0,1]; everywhere for an edit of the whole picture."""
        return torch.from_numpy(self.arrays["mask"][index])[:, None].float() / 255


class Steps(IterableDataset):
    """Endless batches {"step": n} from the trainer's step on: what a step takes follows from its number."""

    def __init__(self, data: PriorData):
        self.data = data

    def __iter__(self) -> Iterator[dict[str, int]]:
        return ({"step": step} for step in count(self.data.trainer.global_step))


@plugin.register("dreamcatalyst-prior-data")
class PriorData(plugin.pl.LightningDataModule):
    """Pairs (source, instruction, edited) of synthetic scenes, in a folder of shards."""

    @dataclass(frozen=True)
    class Config:
        pairs: str = "outputs/pairs"  # the folder; what it lacks is made at the start
        count: AtLeastOne = 8000
        size: Side = 128  # pixels, both sides
        photographs: bool = True  # also pairs of the free photographs inside scikit-image and scikit-learn
        held_out: AtLeastOne = 96  # pairs at least, of whole worlds, that are looked at and never trained on
        seed: Seed = 0

        def __post_init__(self) -> None:
            if self.held_out >= self.count:
                raise ConfigError(f"held_out: got {self.held_out}, expected 1 to count - 1 ({self.count - 1})")

    cfg: Config

    def __init__(self, cfg: Any = None):
        super().__init__()
        self.cfg = parse(self.Config, cfg or {}, "data")
        self.pairs: Pairs | None = None

    def prepare_data(self) -> None:
        """Make the pairs that are not there yet. A folder without pairs.json holds somebody's own and is left alone."""
        if (self.folder / "pairs.json").exists() or not any(self.folder.glob("pairs-*.npz")):
            plugin.info(f"pairs: {self.folder}, made where they are not there yet")
            known = cast(Operators, find_operator)  # no edit's name is empty, for which it gives None
            operators = known if self.cfg.photographs and not self.trial else None
            make_pairs(self.folder, self.count, self.cfg.seed, size=self.cfg.size, photographs=operators)

    @property
    def trial(self) -> bool:
        """Whether this is a trial of one step only."""
        return bool(self.trainer and self.trainer.fast_dev_run)

    @property
    def folder(self) -> Path:
        """Where the pairs are; a trial of one step has a few of its own."""
        return Path(self.cfg.pairs) / "trial" if self.trial else Path(self.cfg.pairs)

    @property
    def count(self) -> int:
        return FEW if self.trial else self.cfg.count

    def setup(self, stage: str) -> None:
        """Read the pairs; the last worlds are held out."""
        if self.pairs is not None:
            return
        self.pairs = Pairs(read_pairs(self.folder))
        size = self.pairs.arrays["source"].shape[1:3]
        if size != (self.cfg.size, self.cfg.size):
            raise DataError(
                f"{self.folder}: pairs of {size[1]} x {size[0]} pixels, expected {self.cfg.size} x {self.cfg.size} as "
                f"data.size says. Set data.size={size[0]}, or name another folder: data.pairs=..."
            )
        world = self.pairs.world
        worlds, sizes = np.unique(world, return_counts=True)
        enough = np.searchsorted(np.cumsum(sizes[::-1]), min(self.cfg.held_out, len(world) // 4)) + 1
        self.held_out = np.flatnonzero(world >= worlds[-enough])
        self.train = np.flatnonzero(world < worlds[-enough])
        if not len(self.train):
            raise DataError(f"{self.folder}: all pairs are of one world, expected several: some are held out whole")

    @property
    def origin(self) -> str:
        """Where the pairs come from, in words, with the photographs' authors and licences."""
        if not (self.folder / "pairs.json").exists():
            return f"Pairs of {self.folder}."
        text = "Renders of small worlds that the project makes itself, before and after an edit in 3D."
        if (self.pairs.world >= 0).all():
            return text
        credits = "\n".join(
            f"- {distribution}, `{Path(name).name}`: {licence}"
            for _, distribution, files in PHOTOGRAPHS
            for name, licence in files.items()
        )
        return f"{text} And crops of photographs, edited by image operators:\n\n{credits}"

    def held_out_spread(self, wanted: int) -> np.ndarray:
        """At most `wanted` of the held-out pairs, evenly spread over them."""
        places = np.linspace(0, len(self.held_out) - 1, min(wanted, len(self.held_out)))
        return self.held_out[places.round().astype(int)]

    def batch(self, step: int, size: int) -> np.ndarray:
        """The `size` training pairs of a step (from 0), as indices into `pairs`; each once per epoch."""
        return self.train[views_for_step(self.cfg.seed, step, len(self.train), size)]

    def crops(self, step: int, size: int, side: int) -> Tensor:
        """`size` crops of side `side` for a step (from 0), of sources and edited images alike, mirrored at random:
        [B,3,side,side] in [0,1]."""
        rng = np.random.default_rng((self.cfg.seed, step, side))
        out = []
        for i in self.batch(step, size):
            top, left = rng.integers(0, self.cfg.size - side + 1, 2)
            image = self.pairs.arrays["source" if rng.random() < 0.4 else "edited"][i]
            crop = image[top : top + side, left : left + side]
            out.append(crop[:, ::-1] if rng.random() < 0.5 else crop)
        return torch.from_numpy(np.stack(out)).permute(0, 3, 1, 2).float() / 255

    def train_dataloader(self) -> DataLoader:
        return DataLoader(Steps(self), batch_size=None)

    def _held_out(self) -> DataLoader:
        parts = np.array_split(self.held_out, -(-len(self.held_out) // 8))
        batches = [{"index": part.tolist()} for part in parts]
        return DataLoader(cast(Dataset, batches), batch_size=None)  # it asks for a length and items

    def val_dataloader(self) -> DataLoader:
        return self._held_out()

    def test_dataloader(self) -> DataLoader:
        return self._held_out()

    def predict_dataloader(self) -> DataLoader:
        return self._held_out()
