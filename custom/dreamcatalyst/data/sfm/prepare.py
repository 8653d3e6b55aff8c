"""Working copies of photographs: upright, of 8 bits, under names that every program takes.

COLMAP does not turn a photograph as its EXIF orientation says, and neither does whoever reads the result, so the copy
is turned. What is upright JPEG or PNG already is copied byte for byte.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DataError
from ...files import replacing
from ..images import decode, image_size
from .choose import CONVERTED, FEWEST
from .options import SfmOptions

MAKE, MODEL, ORIENTATION, EXIF = 0x010F, 0x0110, 0x0112, 0x8769  # tags of EXIF 2.32, and of its own directory
FOCAL, FOCAL35 = 0x920A, 0xA405
TURNS = {2: "FLIP_LEFT_RIGHT", 3: "ROTATE_180", 4: "FLIP_TOP_BOTTOM", 5: "TRANSPOSE", 6: "ROTATE_270"}
TURNS |= {7: "TRANSVERSE", 8: "ROTATE_90"}  # what is done to a photograph of each orientation, as Pillow calls it
QUALITY = 95  # of a JPEG that has to be written anew
SMALLEST = 128  # pixels of the longer side: below, there are too few features


@dataclass(frozen=True)
class Picture:
    """A working copy. name: under `images`. original: where it was made of, as far as a user knows it. camera: a text
    that is the same for those that share intrinsics."""

    name: str
    original: str
    camera: str


def prepare(
    root: Path, chosen: Sequence[Path], folder: Path, options: SfmOptions, tick: Callable[[int], None]
) -> tuple[list[Picture], list[str]]:
    """Make the working copies in `folder` that are not there yet; gives them, and what is said of files that cannot be
    read, which are left aside. tick: told how many are done.

    Raises DataError: more than half of them cannot be read, HEIC without its reader, all too small, panoramas.
    """
    pictures, bad, panoramas, used = [], [], [], set()
    for number, path in enumerate(chosen):
        inside = path.relative_to(root)
        try:
            made = _copy(path, folder, inside, used)
        except DataError as error:
            if "pillow-heif" in str(error):
                raise
            bad.append((inside.as_posix(), error))
            continue
        finally:
            tick(number + 1)
        if made is None:
            panoramas.append(inside.as_posix())
            continue
        pictures.append(Picture(made, inside.as_posix(), _camera(path, inside, folder / made, options)))
    _require(root, len(chosen), pictures, folder, bad, panoramas)
    notices = []
    if bad:
        names = f"{len(bad)} of {len(chosen)} photographs cannot be read and are left aside"
        notices.append(f"{root}: {names}, first '{bad[0][0]}' ({bad[0][1]})")
    if panoramas:
        notices.append(f"{root}: {len(panoramas)} panoramas are left aside, first '{panoramas[0]}'")
    return pictures, notices


def _require(root: Path, n: int, pictures: list[Picture], folder: Path, bad: list, panoramas: list) -> None:
    """Raise DataError where what is left is not what cameras are found from."""
    if bad and (2 * len(bad) > n or len(pictures) < FEWEST):
        raise DataError(f"{root}: {len(bad)} of {n} photographs cannot be read, first: {bad[0][1]}")
    if panoramas and len(pictures) < FEWEST:
        raise DataError(
            f"{root}: '{panoramas[0]}' is a panorama ({len(panoramas)} of {n} are), which no single camera took. Take "
            "ordinary photographs while walking around the scene, or cut it into perspective views"
        )
    sizes = [image_size(folder / picture.name) for picture in pictures]
    if sizes and max(max(size) for size in sizes) < SMALLEST:
        width, height = max(sizes)
        raise DataError(
            f"{root}: the photographs have {width}x{height} pixels at most, too few to find cameras: {SMALLEST} are "
            "needed on the longer side, 1000 and more are good"
        )


def _copy(path: Path, folder: Path, inside: Path, used: set[str]) -> str | None:
    """The name of the working copy of a photograph, which is made where it is not there; None for a panorama."""
    image, exif = _open(path)
    with image:
        width, height = image.size
        orientation = int(exif.get(ORIENTATION, 1) or 1)
        as_it_is = image.format in ("JPEG", "MPO", "PNG") and orientation not in TURNS
        as_it_is = as_it_is and image.mode in ("RGB", "L", "RGBA")
        image_size(path) if as_it_is else None  # raises for one that is cut off, which Pillow does not see yet
        if max(width, height) > 2.5 * min(width, height) or _equirectangular(path, image):
            return None
        see_through = "A" in image.mode or "transparency" in image.info
        suffix = path.suffix.lower() if as_it_is else ".png" if see_through else ".jpg"
        name = _name(inside, suffix, used)
        if not (folder / name).is_file():
            with replacing(folder / name, suffix) as part:
                if as_it_is:
                    shutil.copyfile(path, part)
                else:
                    _convert(path, image, exif, orientation, part)
    return name


def _open(path: Path) -> tuple[Any, Any]:
    """A photograph's file as Pillow opens it, and its EXIF. Raises DataError."""
    from PIL import Image, UnidentifiedImageError

    heic = path.suffix.lower() in CONVERTED[:2]
    if heic:
        try:
            import pillow_heif
        except ImportError:
            remedy = "pip install pillow-heif, or save the photographs as JPEG"
            raise DataError(f"{path}: is a HEIC photograph, which takes the package pillow-heif: {remedy}") from None
        pillow_heif.register_heif_opener()
    try:
        image = Image.open(path)
        return image, image.getexif()
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DataError(f"{path}: is not an image that can be read ({error}); copy it again") from error


def _convert(path: Path, image: Any, exif: Any, orientation: int, part: Path) -> None:
    """Write the photograph upright with 8 bits; its EXIF goes along but for the orientation."""
    from PIL import Image

    try:
        if image.mode.startswith(("I", "F")) or path.suffix.lower() in (".tif", ".tiff"):
            image = Image.fromarray(decode(path, (0.0, 0.0, 0.0)))
        elif part.suffix == ".png":
            image = image.convert("RGBA")
        else:
            image = image.convert("RGB")
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(f"{path}: is cut off or damaged ({error}); copy it again") from error
    if orientation in TURNS:
        image = image.transpose(Image.Transpose[TURNS[orientation]])
    exif.get_ifd(EXIF)  # has Pillow write it again
    exif.pop(ORIENTATION, None)
    image.save(part, **({} if part.suffix == ".png" else {"quality": QUALITY, "exif": exif}))


def _name(inside: Path, suffix: str, used: set[str]) -> str:
    """A name without white space, at which COLMAP's lists of pairs would end, that no other photograph has."""
    stem = re.sub(r"[\s\x00-\x1f]+", "_", inside.with_suffix("").as_posix())
    name, number = stem + suffix, 2
    while name.casefold() in used:
        name, number = f"{stem}-{number}{suffix}", number + 1
    used.add(name.casefold())
    return name


def _camera(path: Path, inside: Path, copy: Path, options: SfmOptions) -> str:
    """Whose intrinsics a photograph shares."""
    width, height = image_size(copy)
    size = f"{width}x{height}"
    if options.cameras == "each":
        return inside.as_posix()
    if options.cameras == "one":
        return size
    if options.cameras == "folder":
        return f"{size} {inside.parent.as_posix()}"
    image, exif = _open(path)
    with image:
        own = exif.get_ifd(EXIF)
        told = [str(exif.get(tag, "")).strip("\0 ") for tag in (MAKE, MODEL)]
        focal = [str(own.get(tag, "")) for tag in (FOCAL, FOCAL35)]
    known = any(focal)
    return " ".join([size, *told, *focal] if known else [size, *told, inside.parent.as_posix()])


def _equirectangular(path: Path, image: Any) -> bool:
    """Whether a photograph shows all directions: it says so (Google's GPano), or it is 2:1 and its right end goes on
    at its left one, as the picture does between two columns."""
    with path.open("rb") as file:
        if b"equirectangular" in file.read(1 << 16):
            return True
    width, height = image.size
    if abs(width - 2 * height) > 0.01 * width or width < 2 * SMALLEST:
        return False
    try:
        small = np.asarray(image.convert("L").resize((256, 128)), np.float32)
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(f"{path}: is cut off or damaged ({error}); copy it again") from error
    steps = np.abs(np.diff(small, axis=1, append=small[:, :1])).mean(axis=0)
    return bool(steps[-1] <= np.quantile(steps[:-1], 0.95))
