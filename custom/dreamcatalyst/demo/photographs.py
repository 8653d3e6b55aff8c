"""Free sample photographs that come inside well-known Python packages, for the edits of whole pictures."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray
from numpy.random import Generator

from ..errors import ConfigError, DataError

Picture = UInt8[ndarray, "H W 3"]

# Package as it is imported, as it is installed, and its files, each with author and licence.
PHOTOGRAPHS: tuple[tuple[str, str, dict[str, str]], ...] = (
    (
        "skimage",
        "scikit-image",
        {
            "data/astronaut.png": "NASA, public domain",
            "data/chelsea.png": "Stefan van der Walt, CC0",
            "data/coffee.png": "Rachel Michetti, CC0",
            "data/rocket.jpg": "SpaceX, public domain",
        },
    ),
    (
        "sklearn",
        "scikit-learn",
        {
            "datasets/images/china.jpg": "danielbuechele, CC BY 2.0",
            "datasets/images/flower.jpg": "vultilion, CC BY 2.0",
        },
    ),
)


def load_photographs() -> list[Picture]:
    """All of PHOTOGRAPHS, RGB. Raises ConfigError where a package is not installed, DataError where it
    lacks the file."""
    found = []
    for package, distribution, files in PHOTOGRAPHS:
        spec = find_spec(package)
        if spec is None:
            raise ConfigError(
                f"photographs: the package '{distribution}', whose sample images they are, is not installed. "
                "Install it with pip install '.[prior-training]', or make pairs without photographs"
            )
        for name in files:
            path = Path(spec.submodule_search_locations[0]) / name
            image = cv2.imread(str(path))
            if image is None:
                raise DataError(f"{path}: expected a sample image of {distribution}, found none. Make pairs without it")
            found.append(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    return found


def crop(images: list[Picture], size: int, rng: Generator) -> UInt8[ndarray, "{size} {size} 3"]:
    """A random square of a random one of `images`, mirrored at times."""
    image = images[rng.integers(len(images))]
    height, width = image.shape[:2]
    side = int(rng.uniform(0.45, 1.0) * min(height, width))
    top, left = rng.integers(height - side + 1), rng.integers(width - side + 1)
    square = image[top : top + side, left : left + side]
    square = square[:, ::-1] if rng.random() < 0.5 else square
    way = cv2.INTER_AREA if side > size else cv2.INTER_LINEAR
    return cv2.resize(np.ascontiguousarray(square), (size, size), interpolation=way)
