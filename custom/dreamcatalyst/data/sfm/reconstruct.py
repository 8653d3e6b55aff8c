"""From working copies to the best model that they give: plainly first, with more effort where that is too little."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ... import plugin
from . import colmap
from .check import require_movement
from .colmap import PLAIN, THOROUGH, Effort, library
from .options import SfmOptions
from .pairs import Pair, choose_pairs, exhaustive
from .prepare import Picture
from .retrieval import likeness

FEW = 20  # photographs up to which each must get a camera before no more effort is made
ENOUGH = 0.9  # share of more photographs that must
MORE = 12  # photographs that look most alike, compared with more effort with each that has no camera


class Found(NamedTuple):
    """A model (a pycolmap Reconstruction, None: none), the database that it is of, how it was found, in words, and the
    numbers of photographs in the other models."""

    model: Any
    database: Path
    how: str
    others: list[int]

    @property
    def count(self) -> int:
        """Photographs that have a camera."""
        return self.model.num_reg_images() if self.model is not None else 0

    @property
    def rank(self) -> tuple[int, int]:
        """What makes one better than another."""
        return self.count, self.model.num_points3D() if self.model is not None else 0


@dataclass
class Search:
    """The search for the cameras of photographs, whose copies are in folder/images and whose databases in `folder`:
    what is done there is not done again. source: for messages. seconds: of each stage of this process, by the
    clock and of the processor."""

    source: Path
    folder: Path
    pictures: Sequence[Picture]
    video: bool
    options: SfmOptions
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        return [picture.name for picture in self.pictures]

    def run(self) -> Found:
        """The model with the most photographs. Raises DataError where they are all taken from one place."""
        n = len(self.pictures)
        enough = n if n <= FEW else math.ceil(ENOUGH * n)
        plain = self.compared(
            PLAIN, lambda base: choose_pairs(n, self.video, self.options, lambda: self.likeness(base))
        )
        require_movement(self.source, plain)
        tried = [self.placed(plain, PLAIN)]
        if tried[-1].count < enough:
            plugin.info(f"cameras: {tried[-1].count} of {n} photographs have one; trying harder")
            hard = self.compared(THOROUGH, lambda base: exhaustive(n) if n <= FEW else self.more_pairs(tried[0]))
            tried.append(self.placed(hard, THOROUGH))
            if tried[-1].count < enough:
                tried.append(self.placed(hard, None))
        return max(tried, key=lambda found: found.rank)

    def compared(self, effort: Effort, pairs: Callable[[Path], list[Pair]]) -> Path:
        """The database with features and matches. pairs: gives, of the database with features, what is compared."""
        database = self.folder / f"{effort.name}.db"
        with self.timed("features"):
            colmap.register(database, self.folder / "images", self.pictures, self.options)
            colmap.extract(database, self.folder / "images", self.names, effort, self.options)
        with self.timed("comparing"):
            colmap.match(database, self.names, pairs(database), effort, self.options)
        return database

    def placed(self, database: Path, effort: Effort | None) -> Found:
        """The largest of the models that have nothing in common. effort None: all photographs at once."""
        images, n = self.folder / "images", len(self.pictures)
        out = self.folder / "models" / (effort.name if effort else "at-once")
        with self.timed("placing"):
            if effort is None:
                models = colmap.reconstruct_at_once(database, images, out, self.options)
            else:
                models = colmap.reconstruct(database, images, out, n, effort, self.options)
        how = "thoroughly, all at once" if effort is None else "plainly" if effort is PLAIN else "thoroughly"
        models = sorted(models, key=lambda m: (m.num_reg_images(), m.num_points3D()), reverse=True)
        others = [model.num_reg_images() for model in models[1:]]
        return Found(models[0] if models else None, database, how, others)

    def likeness(self, database: Path) -> np.ndarray:
        """How alike the photographs are, [n,n]."""
        with library() as pycolmap, pycolmap.Database.open(database) as data:
            numbers = {image.name: image.image_id for image in data.read_all_images()}
            descriptors = [np.asarray(data.read_descriptors(numbers[name]).data) for name in self.names]
        return likeness(descriptors, self.options.seed)

    def more_pairs(self, found: Found) -> list[Pair]:
        """What held together before, and each photograph without a camera with those that look most like it."""
        place = {name: i for i, name in enumerate(self.names)}
        with library() as pycolmap, pycolmap.Database.open(found.database) as data:
            by_number = {image.image_id: place[image.name] for image in data.read_all_images()}
            compared = zip(*data.read_two_view_geometries(), strict=True)
            held = [pycolmap.pair_id_to_image_pair(pair) for pair, geometry in compared if len(geometry.inlier_matches)]
        kept = {(min(by_number[i], by_number[j]), max(by_number[i], by_number[j])) for i, j in held}
        model = found.model
        placed = set() if model is None else {model.images[i].name for i in model.reg_image_ids()}
        scores = self.likeness(found.database)
        for i in (place[name] for name in self.names if name not in placed):
            order = [int(j) for j in np.argsort(-scores[i], kind="stable") if int(j) != i]
            kept |= {(min(i, j), max(i, j)) for j in order[:MORE]}
        return sorted(kept)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        began, used = time.monotonic(), time.process_time()
        yield
        for name, spent in ((stage, time.monotonic() - began), (f"{stage}_processor", time.process_time() - used)):
            self.seconds[name] = round(self.seconds.get(name, 0) + spent, 1)
