"""COLMAP's steps through pycolmap, each so that it goes on where it was interrupted: what is done stands in a database.

They run in a thread of their own, so that the line of progress goes on and Ctrl-C is heard.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch

from ... import plugin
from ...errors import DataError
from ...meter import Meter
from .options import SfmOptions
from .pairs import Pair
from .prepare import Picture

T = TypeVar("T")
OLDEST = (4, 2)
DRAW = 0.2  # seconds between two looks at what is done
BLOCK = 64  # pairs that are compared between two looks at the time


@dataclass(frozen=True)
class Effort:
    """How hard is tried. name: of the database. affine: features whose shape is adapted and averaged over scales
    (DSP-SIFT). peak: contrast that a feature needs. guided: matches are looked for again along the epipolar lines.
    inliers: matches that a pair needs; start: of the first pair; angle: degrees between its views at least; seen:
    matches with the model that a further photograph needs."""

    name: str
    affine: bool
    peak: float
    guided: bool
    inliers: int
    start: int
    angle: float
    seen: int


PLAIN = Effort("plain", False, 0.02 / 3, False, inliers=15, start=100, angle=16.0, seen=30)  # COLMAP's own numbers
THOROUGH = Effort("thorough", True, 0.002, True, inliers=10, start=30, angle=4.0, seen=12)


@contextmanager
def library() -> Iterator[Any]:
    """pycolmap, silent unless the run is verbose. Raises DataError where it is too old, or fails."""
    import pycolmap

    version = tuple(int(part) for part in pycolmap.__version__.split(".")[:2])
    if version < OLDEST:
        wanted = ".".join(map(str, OLDEST))
        remedy = "pip install -U pycolmap, or name a folder that has a COLMAP model"
        raise DataError(f"cameras are found by pycolmap {wanted} or newer, {pycolmap.__version__} is here: {remedy}")
    before = pycolmap.logging.minloglevel
    verbose = logging.getLogger("dreamcatalyst").isEnabledFor(logging.DEBUG)
    pycolmap.logging.minloglevel = before if verbose else 3  # 3: what ends the process
    try:
        yield pycolmap
    except (RuntimeError, ValueError, IndexError) as error:
        raise DataError(f"the cameras could not be found: COLMAP failed ({' '.join(str(error).split())})") from error
    finally:
        pycolmap.logging.minloglevel = before


def watched(work: Callable[[Any], T], look: Callable[[], None] = lambda: None) -> T:
    """What `work` gives, done in a thread, so that Ctrl-C is heard. work: gets a token by which it is told to stop;
    what it has written then stays. look: called now and then.

    Nobody else may look into the database meanwhile: Python has a SQLite of its own, and two of them in one process
    take each other's locks away.
    """
    with library() as pycolmap:
        token, outcome, ended = pycolmap.CancellationToken(), [], threading.Event()

        def run() -> None:
            try:
                outcome.append((work(token), None))
            except BaseException as error:
                outcome.append((None, error))
            ended.set()

        threading.Thread(target=run, daemon=True).start()
        try:
            while not ended.wait(DRAW):  # not Thread.join, which a signal has believe that the thread has ended
                look()
        except BaseException:
            token.cancel()
            plugin.info("cameras: stopping as soon as what is written is whole")
            ended.wait()
            raise
        result, error = outcome[0]
        if error is not None:
            raise error
        return result


def in_blocks(name: str, unit: str, items: Sequence[T], size: int, work: Callable[[Sequence[T], Any], Any]) -> None:
    """`work` on `size` items after the other, with the line of progress. work: gets the items, and the token."""
    meter = Meter(f"cameras: {name}", len(items), unit)
    try:
        for start in range(0, len(items), size):
            block = items[start : start + size]
            watched(lambda token, block=block: work(block, token))
            meter.update(start + len(block))
    finally:
        meter.close()


def register(database: Path, images: Path, pictures: Sequence[Picture], options: SfmOptions) -> None:
    """Enter the photographs and their cameras into a database, where there is none yet; focal lengths are the EXIF's
    where it has some."""
    if database.is_file():
        return
    groups: dict[str, list[str]] = {}
    for picture in pictures:
        groups.setdefault(picture.camera, []).append(picture.name)
    part = database.with_suffix(".part.db")
    for path in part.parent.glob(f"{part.name}*"):
        path.unlink()
    with library() as pycolmap:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = options.model
        pycolmap.Database.open(part).close()
        for names in groups.values():
            pycolmap.import_images(part, images, pycolmap.CameraMode.SINGLE, names, reader)
    part.rename(database)


def extract(database: Path, images: Path, names: Sequence[str], effort: Effort, options: SfmOptions) -> None:
    """Find the features of all photographs that have none yet."""
    with library() as pycolmap:
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.max_image_size, extraction.num_threads = options.side, torch.get_num_threads()
        extraction.sift.max_num_features, extraction.sift.peak_threshold = options.features, effort.peak
        extraction.sift.estimate_affine_shape = extraction.sift.domain_size_pooling = effort.affine

        def work(block: Sequence[str], token: Any) -> None:
            pycolmap.extract_features(
                database,
                images,
                list(block),
                extraction_options=extraction,
                device=pycolmap.Device.cpu,
                cancellation_token=token,
            )

        with pycolmap.Database.open(database) as data:
            done = {image.name for image in data.read_all_images() if data.exists_keypoints(image.image_id)}
        missing = [name for name in names if name not in done]
        in_blocks("features", "photograph", missing, 2 * torch.get_num_threads(), work)


def match(database: Path, names: Sequence[str], pairs: Sequence[Pair], effort: Effort, options: SfmOptions) -> None:
    """Compare the pairs that were not compared yet."""
    listed = database.with_suffix(".pairs.txt")
    with library() as pycolmap:
        matching, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
        matching.num_threads, matching.guided_matching = torch.get_num_threads(), effort.guided
        pairing.match_list_path, pairing.block_size = listed, BLOCK
        verification = pycolmap.TwoViewGeometryOptions()
        verification.min_num_inliers, verification.ransac.random_seed = effort.inliers, options.seed

        def work(block: Sequence[Pair], token: Any) -> None:
            listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in block), encoding="utf-8")
            pycolmap.match_image_pairs(database, matching, pairing, verification, pycolmap.Device.cpu, token)

        with pycolmap.Database.open(database) as data:
            number = {image.name: image.image_id for image in data.read_all_images()}
            missing = [
                (i, j) for i, j in pairs if not data.exists_two_view_geometry(number[names[i]], number[names[j]])
            ]
        in_blocks("comparing", "pair", missing, BLOCK, work)


def reconstruct(database: Path, images: Path, out: Path, n: int, effort: Effort, options: SfmOptions) -> list[Any]:
    """The models that the photographs give, one view after the other; none where no two begin one."""
    with library() as pycolmap:
        pycolmap.set_random_seed(options.seed)
        mapping = pycolmap.IncrementalPipelineOptions()
        mapping.num_threads, mapping.random_seed = torch.get_num_threads(), options.seed
        mapping.min_num_matches, mapping.min_model_size = effort.inliers, 3
        mapping.mapper.init_min_num_inliers, mapping.mapper.init_min_tri_angle = effort.start, effort.angle
        mapping.mapper.abs_pose_min_num_inliers = effort.seen
        placed = [0]

        def more() -> None:
            placed[0] = min(n, placed[0] + 1)

        out.mkdir(parents=True, exist_ok=True)
        meter = Meter("cameras: placing", n, "photograph")
        try:
            models = watched(
                lambda token: pycolmap.incremental_mapping(
                    database,
                    images,
                    out,
                    mapping,
                    initial_image_pair_callback=more,
                    next_image_callback=more,
                    cancellation_token=token,
                ),
                lambda: meter.update(placed[0]),
            )
        finally:
            meter.close()
        return list(models.values())


def reconstruct_at_once(database: Path, images: Path, out: Path, options: SfmOptions) -> list[Any]:
    """The models that the photographs give where all are placed together (GLOMAP, Pan et al., ECCV 2024)."""
    with library() as pycolmap:
        mapping = pycolmap.GlobalPipelineOptions()
        mapping.num_threads, mapping.random_seed = torch.get_num_threads(), options.seed
        out.mkdir(parents=True, exist_ok=True)
        return list(watched(lambda token: pycolmap.global_mapping(database, images, out, mapping)).values())
