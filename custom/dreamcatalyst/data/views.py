"""A capture: photographs with their cameras, whatever format they came in, and which of them are trained on."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..errors import ConfigError, DataError, nearest
from .camera import Cameras
from .formats import CaptureOptions, Points
from .images import ImageCache, Photo
from .origin import ZERO, Origin
from .truth import GroundTruth, GroundTruths, SplatScene


@dataclass(frozen=True)
class View:
    """One view. camera: a batch of one, at the size in which the view is used; photo None: there is no file of one."""

    name: str
    camera: Cameras
    photo: Photo | None


@dataclass(frozen=True)
class Capture:
    """Views sorted by name; train and test are indices into them. source: the folder or file that was read.

    points: those of the reconstruction, if any. notices: sentences for the user about what was left aside. origin: the
    point of the files' world that is (0,0,0) here (data/origin.py). scene: splats whose renders are the photographs,
    where there are no files of any. truths: what edits become, where that is known. found: the folder with report.json
    and cameras.png of how cameras were found, where they were (data/sfm).
    """

    source: Path
    views: list[View]
    train: list[int]
    test: list[int]
    points: Points | None = None
    notices: tuple[str, ...] = ()
    options: CaptureOptions = CaptureOptions()
    origin: Origin = ZERO
    scene: SplatScene | None = None
    truths: GroundTruths | None = None
    found: Path | None = None

    def __len__(self) -> int:
        return len(self.views)

    @property
    def has_photos(self) -> bool:
        """Whether every view has a photograph, be it a render."""
        return self.scene is not None or all(view.photo is not None for view in self.views)

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

    def image(self, index: int, render: Callable[[SplatScene, Cameras], Tensor] | None = None) -> Tensor:
        """The photograph of a view at its camera's size: float32 [H,W,3] in [0,1].

        render: draws one camera's view [H,W,3] of `scene`, where the capture has one; each view is drawn once, whoever
        asks. Raises DataError where there is no photograph, it cannot be read, or nothing draws it.
        """
        if self.scene is not None and render is not None:
            if index not in self._renders:
                self._renders[index] = render(self.scene, self.views[index].camera)
            return self._renders[index]
        return torch.from_numpy(self._cache.get(index)).float() / 255

    @property
    def has_masks(self) -> bool:
        """Whether a part of some photograph is to be left out of fits."""
        return any(view.photo is not None and view.photo.mask is not None for view in self.views)

    def kept(self, index: int) -> Tensor | None:
        """What counts of a photograph in a fit, [H,W,1] of 0 and 1; None: all of it. Raises DataError."""
        photo = self.views[index].photo
        mask = None if photo is None else photo.load_mask()
        return None if mask is None else torch.from_numpy(mask).float()[..., None]

    def alpha(self, index: int) -> Tensor | None:
        """How opaque a photograph is, [H,W,1] in [0,1]; None: its file says nothing of it. Raises DataError."""
        photo = self.views[index].photo
        alpha = None if photo is None else photo.load_alpha()
        return None if alpha is None else torch.from_numpy(alpha).float()[..., None] / 255

    def prefetch(self, indices: Iterable[int]) -> None:
        """Begin to load these photographs in the background, as many as fit in options.resident_gib."""
        if self.scene is None and self.has_photos:
            self._cache.prefetch(indices)

    def truth(self, instruction: str) -> GroundTruth | None:
        """What the capture becomes by an edit; None where that is not known, as of photographs."""
        return None if self.truths is None else self.truths.find(instruction)

    def transformed(self, similarity: Tensor) -> Capture:
        """The same capture in another world: x' = similarity x, [4,4], rotation times one scale and a translation.

        Raises DataError for one that carries splats.
        """
        if self.scene is not None:
            raise DataError(f"{self.source}: carries splats, which stay in their own world. Leave out data.dataparser")
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
    def _renders(self) -> dict[int, Tensor]:
        return {}

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


def view_number(view: str, names: Sequence[str], where: str) -> int:
    """The view that is meant, of all `names` of a capture: by name, or else by number. where: the key that says it.
    Raises ConfigError."""
    if view in names:
        return list(names).index(view)
    if view.isdecimal() and int(view) < len(names):
        return int(view)
    raise ConfigError(
        f"{where}: no view '{view}'.{nearest(view, names)} "
        f"Known: the names of the {len(names)} views, or 0 to {len(names) - 1}."
    )


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
