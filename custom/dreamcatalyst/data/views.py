"""A capture: photographs with their cameras, whatever format they came in, and which of them are trained on."""

from __future__ import annotations

import filecmp
import json
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..config import AtLeastOne, Colour, Count, NonNegative, Range, Side
from ..errors import DataError
from ..memory import free_memory
from ..registry import Registry
from .camera import Cameras
from .images import ImageCache, Photo, image_size, there
from .lens import Lens
from .origin import ZERO, Origin, far_origin

FORMATS = Registry("dataset format", __package__)
FORMATS.add("colmap", ".colmap:FORMAT")
FORMATS.add("inria", ".inria:FORMAT")
FORMATS.add("nerfstudio", ".transforms:FORMAT")
AXES = {f"{sign}{axis}": i for sign in ("", "-") for i, axis in enumerate("xyz")}  # what data.orbit_up may name


@dataclass(frozen=True)
class CaptureOptions:
    """How a capture is read; the defaults are those of 3DGS."""

    format: str | None = field(default=None, metadata={"choices": FORMATS})  # None: whichever finds its files
    images: str = "images"  # folder of the photographs in a COLMAP capture
    downscale: Annotated[float, Range("[1, inf)")] = 1.0  # photographs are made smaller by this factor, at least 1
    width: Side | None = None  # pixels; with height: centred crop to their aspect, then resize
    height: Side | None = None  # pixels; width or height alone: the other follows the photograph's aspect
    max_side: Side | None = None  # pixels, longer side at most, where no downscale, width or height is given
    test_every: Count = 8  # every so many views one is held out, from the first on; 0: none
    max_view_num: AtLeastOne | None = None  # views to train on at most, spread evenly over the capture; None: all
    resident_gib: NonNegative = 2.0  # GiB of decoded photographs kept in memory
    background: Colour = (0.0, 0.0, 0.0)  # RGB in [0,1] behind transparent photographs
    dataparser: str = ""  # nerfstudio's dataparser_transforms.json of the splats: cameras are moved into their world
    orbit_views: Annotated[int, Range("[1, 10000]")] = 48  # views of an orbit around splats that come without cameras
    orbit_up: str = field(default="-y", metadata={"choices": AXES})  # up in them: -y suits COLMAP's, z nerfstudio's

    def __post_init__(self) -> None:
        sized = self.width is not None or self.height is not None
        if self.downscale != 1 and sized:
            raise DataError("data.downscale and data.width or data.height: both set a size; leave one of them out")


LONGEST = 32766  # pixels of a view's side; OpenCV resamples no longer ones
SMALLER = "Set data.max_side or data.downscale"
FARTHEST = 1e15  # world units; float32 holds its square
DECODED, UNDISTORTED = 12, 24  # bytes per pixel of a photograph at most while it is decoded, and undistorted
DRAWN = 100  # bytes per pixel of a view at least: its render, gradients, photograph and loss in float32


class Points(NamedTuple):
    """Points of a reconstruction. xyz [P,3] world units (float64 as a format reads them, float32 in a capture), rgb
    [P,3] in [0,1]."""

    xyz: Tensor
    rgb: Tensor


@dataclass(frozen=True)
class Shot:
    """What a format says of one photograph. viewmat [4,4] float64 world to camera, OpenCV axes; lens as calibrated,
    which may be at another size than the file; path None: there is no photograph."""

    name: str
    viewmat: np.ndarray
    lens: Lens
    path: Path | None


@dataclass(frozen=True)
class Scan:
    """What a format reads from its files. notices: sentences for the user about what was left aside."""

    shots: list[Shot]
    points: Points | None
    notices: list[str]


@dataclass(frozen=True)
class Format:
    """A dataset format. looks_for: its files, in words. find: the path to read, given a source, or None where the
    source has none of its files. read: what stands at that path."""

    looks_for: str
    find: Callable[[Path], Path | None]
    read: Callable[[Path, CaptureOptions], Scan]


@dataclass(frozen=True)
class View:
    """One view. camera: a batch of one, at the size in which the view is used; photo None: there is no photograph."""

    name: str
    camera: Cameras
    photo: Photo | None


@dataclass(frozen=True)
class Capture:
    """Views sorted by name; train and test are indices into them. source: the folder or file that was read.

    points: those of the reconstruction, if any. notices: sentences for the user about what was left aside. origin: the
    point of the files' world that is (0,0,0) here (data/origin.py).
    """

    source: Path
    views: list[View]
    train: list[int]
    test: list[int]
    points: Points | None = None
    notices: tuple[str, ...] = ()
    options: CaptureOptions = CaptureOptions()
    origin: Origin = ZERO

    def __len__(self) -> int:
        return len(self.views)

    @property
    def has_photos(self) -> bool:
        """Whether every view has a photograph."""
        return all(view.photo is not None for view in self.views)

    def cameras(self, indices: Iterable[int] | None = None) -> Cameras:
        """The cameras of these views (all: None) as one batch. Raises DataError where their image sizes differ."""
        return Cameras.cat([self.views[i].camera for i in (range(len(self)) if indices is None else indices)])

    @cached_property
    def extent(self) -> float:
        """Radius of the training cameras in world units, 1.1 times the largest distance from their mean centre:
        what 3DGS scales its learning rates and its densification with. 1 where all stand at one place."""
        centers = torch.cat([self.views[i].camera.centers for i in self.train])
        return 1.1 * float((centers - centers.mean(dim=0)).norm(dim=1).max()) or 1.0

    @property
    def training_cameras(self) -> Cameras:
        """The training cameras as one batch, for a path among them."""
        return self.poses(self.train)

    def poses(self, indices: Iterable[int]) -> Cameras:
        """The cameras of these views as one batch whatever their image sizes, for what asks where they stand: where
        sizes differ, all get the commonest one and the median intrinsics of its cameras."""
        cameras = [self.views[i].camera for i in indices]
        (width, height), count = Counter((c.width, c.height) for c in cameras).most_common(1)[0]
        if count == len(cameras):
            return Cameras.cat(cameras)
        K = torch.cat([c.Ks for c in cameras if (c.width, c.height) == (width, height)]).median(dim=0).values
        return Cameras(torch.cat([c.viewmats for c in cameras]), K.repeat(len(cameras), 1, 1), width, height)

    def image(self, index: int) -> Tensor:
        """The photograph of a view at its camera's size: float32 [H,W,3] in [0,1], a new tensor.

        Raises DataError where there is none or it cannot be read.
        """
        return torch.from_numpy(self._cache.get(index)).float() / 255

    def prefetch(self, indices: Iterable[int]) -> None:
        """Begin to load these photographs in the background, as many as fit in options.resident_gib."""
        self._cache.prefetch(indices)

    def transformed(self, similarity: Tensor) -> Capture:
        """The same capture in another world: x' = similarity x, [4,4], rotation times one scale and a translation."""
        similarity = similarity.double()
        scale = similarity[:3, :3].det() ** (1 / 3)
        inverse = torch.linalg.inv(similarity)
        views = []
        for view in self.views:
            viewmats = view.camera.viewmats.double() @ inverse
            viewmats[:, :3] *= scale  # the camera's own axes grow with the world, so that its rotation stays one
            viewmats = viewmats.to(view.camera.viewmats.dtype)
            views.append(replace(view, camera=replace(view.camera, viewmats=viewmats)))
        points = self.points
        if points is not None:
            xyz = points.xyz.double() @ similarity[:3, :3].T + similarity[:3, 3]
            points = Points(xyz.to(points.xyz.dtype), points.rgb)
        return replace(self, views=views, points=points, origin=ZERO)

    @cached_property
    def _cache(self) -> ImageCache:
        return ImageCache(self._load, self._bytes, int(self.options.resident_gib * 2**30))

    def _bytes(self, index: int) -> int:
        return self.views[index].camera.width * self.views[index].camera.height * 3

    def _load(self, index: int) -> np.ndarray:
        view = self.views[index]
        if view.photo is None:
            raise DataError(f"{self.source}: view '{view.name}' has a camera but no photograph")
        return view.photo.load(self.options.background)


def open_capture(source: str | Path, options: CaptureOptions = CaptureOptions()) -> Capture:
    """Read the cameras of a capture and check that its photographs are there; pixels are read when asked for.

    source: a folder (or the JSON file itself) of one of FORMATS. Raises DataError: no such folder, none of the
    formats, photographs missing or of another shape than their camera, no view left to train on, a dataparser that
    cannot be read.
    """
    source = Path(source)
    if not there(source):
        raise DataError(f"data.source: {source}: no such file or folder")
    names = FORMATS.names() if options.format is None else [options.format]
    formats = [FORMATS.get(name, "data.format") for name in names]
    format, found = next(((f, p) for f in formats if (p := f.find(source)) is not None), (None, source))
    if format is None:
        wanted = "; ".join(f"{name}: {f.looks_for}" for name, f in zip(names, formats, strict=True))
        held = ", ".join(sorted(p.name for p in source.iterdir())[:8]) if source.is_dir() else "a file"
        raise DataError(f"data.source: {source}: is no capture. Looked for {wanted}. Found {held or 'nothing'}")
    scan = format.read(found, options)
    if not scan.shots:
        raise DataError(f"{found}: is an empty reconstruction: no photograph has a camera. Reconstruct it again")
    shots = sorted(scan.shots, key=lambda shot: shot.name)
    _check(found, shots)
    shots, points, origin = _recentred(shots, scan.points)
    views = [_view(shot, options) for shot in shots]
    train, test = split(len(views), options, found)
    capture = Capture(found, views, train, test, points, tuple(scan.notices), options, origin)
    if not options.dataparser:
        return capture
    from .transforms import splats_from_capture

    back = torch.eye(4, dtype=torch.float64)
    back[:3, 3] = torch.tensor(origin, dtype=torch.float64)
    return capture.transformed(splats_from_capture(options.dataparser, found).double() @ back)


def split(n: int, options: CaptureOptions, where: object = "capture") -> tuple[list[int], list[int]]:
    """Indices to train on and to hold out (0, test_every, 2 test_every ...), as 3DGS does."""
    test = list(range(0, n, options.test_every)) if options.test_every else []
    train = sorted(set(range(n)) - set(test))
    if not train:
        every = f"data.test_every={options.test_every}"
        raise DataError(f"{where}: {every} holds out all of its {n} views; set data.test_every=0 to train on them")
    if options.max_view_num is not None and options.max_view_num < len(train):
        train = [train[i] for i in np.linspace(0, len(train) - 1, options.max_view_num).round().astype(int)]
    return train, test


def views_for_step(seed: int, step: int, n_views: int, batch: int = 1) -> list[int]:
    """Which `batch` of `n_views` views step `step` (from 0) takes: without replacement in each epoch, a new order each.

    A pure function of its arguments, so that a resumed run goes on with the same views.
    """
    epochs: dict[int, np.ndarray] = {}
    out = []
    for place in range(step * batch, (step + 1) * batch):
        epoch, index = divmod(place, n_views)
        if epoch not in epochs:
            epochs[epoch] = np.random.default_rng((seed, epoch)).permutation(n_views)
        out.append(int(epochs[epoch][index]))
    return out


def read_json(path: Path) -> Any:
    """A JSON file's content. Raises DataError where it cannot be read."""
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read as JSON ({error})") from error


def _check(source: Path, shots: list[Shot]) -> None:
    missing = [shot for shot in shots if shot.path is not None and not (there(shot.path) and shot.path.is_file())]
    if missing:
        count = f"{len(missing)} of {len(shots)} photographs are missing"
        raise DataError(f"{source}: {count}, first '{missing[0].path}'. Put them there, or set data.images")
    _require_different(source, shots)
    for shot in shots:
        shot.lens.check(f"{source}: the camera of '{shot.name}'")
        rotation = shot.viewmat[:3, :3]
        if not (np.abs(shot.viewmat) < FARTHEST).all():
            raise DataError(f"{source}: the pose of '{shot.name}' is not of finite numbers")
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-2) or not np.linalg.det(rotation) > 0:
            raise DataError(f"{source}: the pose of '{shot.name}' is not a rotation and a translation")


def _require_different(source: Path, shots: list[Shot]) -> None:
    """Raise DataError where one photograph stands there twice, under one name or as two files: what is held out would
    also be trained on."""
    paths: dict[Path, Shot] = {}
    poses: dict[bytes, list[Shot]] = {}
    for shot in shots:
        if shot.path is None:
            continue
        alike = [paths.get(shot.path.resolve()), *poses.get(shot.viewmat.tobytes(), ())]
        other = next((o for o in alike if o and (o.path == shot.path or filecmp.cmp(o.path, shot.path, False))), None)
        if other is not None:
            names = f"'{shot.name}'" if other.name == shot.name else f"'{other.name}' and '{shot.name}'"
            raise DataError(f"{source}: the photograph {names} is there twice. Take one out: one may be held out")
        paths[shot.path.resolve()] = shot
        poses.setdefault(shot.viewmat.tobytes(), []).append(shot)


def _recentred(shots: list[Shot], points: Points | None) -> tuple[list[Shot], Points | None, Origin]:
    """Cameras and points (float32) of a world that is far away moved to its middle, and where that is."""
    origin = far_origin(np.stack([-shot.viewmat[:3, :3].T @ shot.viewmat[:3, 3] for shot in shots]))
    if points is not None:
        xyz = points.xyz.double() - torch.tensor(origin, dtype=torch.float64)
        points = Points(xyz.float(), points.rgb)
    if origin == ZERO:
        return shots, points, origin
    moved = []
    for shot in shots:
        viewmat = shot.viewmat.copy()
        viewmat[:3, 3] += viewmat[:3, :3] @ np.array(origin)
        moved.append(replace(shot, viewmat=viewmat))
    return moved, points, origin


def _view(shot: Shot, options: CaptureOptions) -> View:
    lens = shot.lens if shot.path is None else _at_file_size(shot)
    if shot.path is not None:
        each, size = UNDISTORTED if lens.distorted else DECODED, f"{lens.width}x{lens.height}"
        require_memory(lens.width * lens.height * each, f"{shot.path}: {size} pixels", "Make smaller copies")
    window, width, height = fit(lens.width, lens.height, options)
    try:
        K, viewmat = torch.from_numpy(lens.pinhole().K), torch.from_numpy(shot.viewmat)
    except DataError as error:
        raise DataError(f"'{shot.name}': {error}") from error
    camera = Cameras(viewmat[None], K[None], lens.width, lens.height).cropped(*window).resized(width, height)
    photo = None if shot.path is None else Photo(shot.path, lens, window, width, height)
    return View(shot.name, camera.to(dtype=torch.float32), photo)


def _at_file_size(shot: Shot) -> Lens:
    """The lens at the size of the image file, which may be a smaller copy (images_4) but not of another shape."""
    width, height = image_size(shot.path)
    lens = shot.lens
    if abs(width * lens.height - height * lens.width) > 1.5 * max(lens.width, lens.height):  # 1.5 px: rounded copies
        turned = abs(width * lens.width - height * lens.height) <= 1.5 * max(lens.width, lens.height)
        hint = " It lies on its side: reconstruct with EXIF orientation removed." if turned else ""
        shapes = f"is {width}x{height}, which is not the shape of its camera, {lens.width}x{lens.height}"
        raise DataError(f"{shot.path}: {shapes}.{hint}")
    return lens.scaled(width, height)


def require_memory(needed: float, what: str, remedy: str) -> None:
    """Raise DataError where `needed` bytes are more than are free."""
    free = free_memory()
    if needed > free:
        raise DataError(f"{what} need {needed / 2**30:.1f} GiB, and {free / 2**30:.1f} GiB are free. {remedy}.")


def fit(width: int, height: int, options: CaptureOptions) -> tuple[tuple[int, int, int, int], int, int]:
    """The window (left, top, width, height) of an image that is shown, and the width and height it is resized to.

    Raises DataError for a size that memory does not hold."""
    window, *size = _fit(width, height, options)
    if max(size) > LONGEST:
        raise DataError(f"data: views of {size[0]}x{size[1]} pixels, expected {LONGEST} a side at most. {SMALLER}.")
    require_memory(size[0] * size[1] * DRAWN, f"data: views of {size[0]}x{size[1]} pixels", SMALLER)
    return window, *size


def _fit(width: int, height: int, options: CaptureOptions) -> tuple[tuple[int, int, int, int], int, int]:
    if options.width is None and options.height is None:
        smaller = options.downscale
        if smaller == 1 and options.max_side is not None:
            smaller = max(1.0, max(width, height) / options.max_side)
        size = (max(1, round(width / smaller)), max(1, round(height / smaller)))
        return (0, 0, width, height), *size
    out_width = options.width or max(1, round(options.height * width / height))
    out_height = options.height or max(1, round(options.width * height / width))
    if options.width is None or options.height is None:
        return (0, 0, width, height), out_width, out_height
    crop_width = min(width, max(1, round(height * out_width / out_height)))
    crop_height = min(height, max(1, round(width * out_height / out_width)))
    left, top = (width - crop_width) // 2, (height - crop_height) // 2
    return (left, top, crop_width, crop_height), out_width, out_height
