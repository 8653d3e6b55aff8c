"""Photographs, read when they are asked for, ahead of time in parallel, and never more of them than fit."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..errors import DataError
from .lens import Lens, undistort

DEFLATE = 1032  # the most that PNG's compression makes of a byte
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")


@dataclass(frozen=True)
class Photo:
    """A photograph and the part of it that a view shows.

    lens: what it was taken with, at the file's own size. window: left, top, width, height in pixels of the undistorted
    photograph. width, height: the size to which the window is resized. mask: a picture of the same size, black where
    the photograph is to be left out of a fit.
    """

    path: Path
    lens: Lens
    window: tuple[int, int, int, int]
    width: int
    height: int
    mask: Path | None = None

    def load(self, background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
        """Decode, lay over `background` (RGB in [0,1]) where transparent, undistort, crop, resize: uint8 [H,W,3].

        Shrinking averages over areas. Raises DataError where the file cannot be decoded or has changed its size.
        """
        return self._placed(decode(self.path, background), self.path)

    def load_alpha(self) -> np.ndarray | None:
        """How opaque the photograph is, uint8 [H,W]; None for a file without alpha, such as a JPEG."""
        image = _read(self.path)
        if image.ndim != 3 or image.shape[2] != 4:
            return None
        return self._placed(np.ascontiguousarray(image[..., 3]), self.path)

    def load_mask(self) -> np.ndarray | None:
        """What counts of the photograph, bool [H,W]: pixels of which half at least are not black in the mask; None
        where there is no mask. Raises DataError for one that cannot be read or has another size."""
        if self.mask is None:
            return None
        image = _read(self.mask)
        kept = image > 0 if image.ndim == 2 else (image[..., :3] > 0).any(axis=2)
        return self._placed(kept.astype(np.uint8) * 255, self.mask) >= 128

    def _placed(self, image: np.ndarray, path: Path) -> np.ndarray:
        """A picture in the file's pixels, read from `path`, as the view shows it."""
        if image.shape[:2] != (self.lens.height, self.lens.width):
            size, expected = f"{image.shape[1]}x{image.shape[0]}", f"{self.lens.width}x{self.lens.height}"
            said = f"its header said {expected}" if path == self.path else f"its photograph is {expected}"
            raise DataError(f"{path}: decodes to {size}, {said}")
        left, top, width, height = self.window
        image = undistort(image, self.lens)[top : top + height, left : left + width]
        if (width, height) != (self.width, self.height):
            shrinks = self.width <= width and self.height <= height
            method = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
            image = cv2.resize(image, (self.width, self.height), interpolation=method)
        return np.ascontiguousarray(image)


def there(path: Path) -> bool:
    """Whether there is such a file or folder; under a name that none can have, a very long one, there is not."""
    try:
        return path.exists()
    except OSError:
        return False


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file as stored (EXIF orientation is not applied), from its header alone."""
    from PIL import Image, UnidentifiedImageError

    try:
        with _any_size(), Image.open(path) as image:
            size = image.size
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise DataError(f"{path}: is not an image that can be read ({error})") from error
    _require_whole(path, size)
    return size


@contextmanager
def _any_size() -> Iterator[None]:
    """Lifts Pillow's guard against images of more than 179 megapixels: panoramas have more, and what can be decoded is
    a question of memory (`views.require_memory`)."""
    from PIL import Image

    before, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = before


def _read(path: Path) -> np.ndarray:
    """uint8 [H,W] or [H,W,BGR or BGRA] of an image file as stored, of 8 or 16 bits."""
    try:
        image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    except (OSError, cv2.error) as error:
        raise DataError(f"{path}: cannot be read ({error})") from error
    if image is None:
        raise DataError(f"{path}: is damaged or not an image; copy it again")
    if image.dtype == np.uint16:
        image = (image / 257).round().astype(np.uint8)
    if image.dtype != np.uint8:
        raise DataError(f"{path}: has pixels of type {image.dtype}, expected 8 or 16 bits")
    return image


def decode(path: Path, background: tuple[float, float, float]) -> np.ndarray:
    """RGB uint8 [H,W,3] of an image file as stored: grey, colour or with alpha."""
    image = _read(path)
    if image.ndim == 2:
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    rgb = np.ascontiguousarray(image[..., 2::-1])
    if image.shape[2] == 4:
        alpha = image[..., 3:] / np.float32(255)
        behind = np.asarray(background, np.float32) * 255
        rgb = (rgb * alpha + behind * (1 - alpha)).round().astype(np.uint8)
    return rgb


def _require_whole(path: Path, size: tuple[int, int]) -> None:
    """Raise DataError where a PNG or JPEG was cut off: OpenCV makes up what is missing, and Pillow tells. It is asked
    only of a file that does not end as these do, such as one with a telephone's trailer."""
    with path.open("rb") as file:
        head = file.read(8)
        file.seek(-min(8, path.stat().st_size), os.SEEK_END)
        tail = file.read()
    if head.startswith(b"\x89PNG") and size[0] * size[1] > 8 * DEFLATE * path.stat().st_size:
        raise DataError(f"{path}: is cut off or damaged: so few bytes do not hold {size[0]}x{size[1]} pixels")
    if head.startswith((b"\x89PNG", b"\xff\xd8\xff")) and not tail.endswith((b"IEND\xaeB`\x82", b"\xff\xd9")):
        from PIL import Image

        try:
            with _any_size(), Image.open(path) as image:
                image.load()
        except (OSError, SyntaxError) as error:
            raise DataError(f"{path}: is cut off or damaged ({error}); copy it again") from error


class ImageCache:
    """Images by number, loaded by a few threads; the least recently used go when `limit` bytes are exceeded.

    load: number -> uint8 array, may run in any thread. size: number -> bytes of that array.
    """

    def __init__(self, load: Callable[[int], np.ndarray], size: Callable[[int], int], limit: int):
        self._load, self._size, self.limit = load, size, limit
        self._held: OrderedDict[int, Future[np.ndarray]] = OrderedDict()
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(max_workers=min(8, max(2, os.cpu_count() or 2)), thread_name_prefix="images")

    @property
    def resident(self) -> int:
        """Bytes of the images that are held or on their way."""
        with self._lock:
            return sum(map(self._size, self._held))

    def get(self, index: int) -> np.ndarray:
        """The image, loaded now if need be. An error of loading is raised here and not remembered."""
        future = self._want(index)
        try:
            return future.result()
        except Exception:
            with self._lock:
                self._held.pop(index, None)
            raise

    def prefetch(self, indices: Iterable[int]) -> None:
        """Begin to load these, as many as fit together, without waiting."""
        room = self.limit
        for index in indices:
            room -= self._size(index)
            if room < 0:
                return
            self._want(index)

    def _want(self, index: int) -> Future[np.ndarray]:
        with self._lock:
            if index not in self._held:
                self._held[index] = self._pool.submit(self._load, index)
            self._held.move_to_end(index)
            total = sum(map(self._size, self._held))
            while total > self.limit and len(self._held) > 1:
                total -= self._size(self._held.popitem(last=False)[0])
            return self._held[index]
