"""A contact sheet of training pairs: source and edited side by side, with the instruction below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy import ndarray

CAPTION = 16  # pixels of height below each pair


def contact_sheet(pairs: Mapping[str, ndarray], chosen: Sequence[int], columns: int = 4) -> ndarray:
    """One RGB image, uint8 [H,W,3], of the pairs with the indices `chosen`, `columns` of them in a row."""
    tiles = []
    for i in chosen:
        both = np.concatenate([pairs["source"][i], pairs["edited"][i]], 1)
        caption = np.full((CAPTION, both.shape[1], 3), 255, np.uint8)
        text = str(pairs["instruction"][i]) or "(no instruction)"
        cv2.putText(caption, text, (2, CAPTION - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.33, (0, 0, 0), 1, cv2.LINE_AA)
        tiles.append(np.concatenate([both, caption], 0))
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
    rows = [np.concatenate(tiles[i : i + columns], 1) for i in range(0, len(tiles), columns)]
    return np.concatenate(rows, 0)
