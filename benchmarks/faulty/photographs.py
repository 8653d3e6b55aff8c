"""Photographs and videos without cameras, of which none can be found."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from .cases import Case, Place, case

fit = partial(case, config="fit", seconds=12)
P, V = "photographs", "video"


def noise(seed: int, width: int = 256, height: int = 192, cell: int = 6) -> np.ndarray:
    """A picture of squares of random colours, which no other seed has."""
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 255, (max(1, height // cell), max(1, width // cell), 3), np.uint8)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_NEAREST)


def photographs(*pictures: np.ndarray | bytes, suffix: str = ".png") -> Callable[[Place], list[str]]:
    """A folder of these pictures, or of files of these bytes."""

    def given(place: Place) -> list[str]:
        for i, picture in enumerate(pictures):
            path = place / f"photos/{i:02d}{suffix}"
            if isinstance(picture, bytes):
                path.write_bytes(picture)
            else:
                cv2.imwrite(str(path), picture)
        return ["data.source=photos"]

    return given


def panoramas() -> list[np.ndarray]:
    """Pictures of 2:1 whose right end goes on at the left one."""
    wide = [cv2.GaussianBlur(np.tile(noise(i, 256, 256, 16), (1, 3, 1)), (0, 0), 3) for i in range(4)]
    return [np.ascontiguousarray(each[:, 256:512].repeat(2, axis=1)) for each in wide]


def video(frames: list[np.ndarray], keep: float = 1.0) -> Callable[[Place], list[str]]:
    """A video of these frames, of whose file the first part is there."""

    def given(place: Place) -> list[str]:
        path = place / "walk.mp4"
        height, width = frames[0].shape[:2]
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25, (width, height))
        for frame in frames:
            writer.write(frame)
        writer.release()
        data = path.read_bytes()
        path.write_bytes(data[: int(len(data) * keep)])
        return ["data.source=walk.mp4"]

    return given


def one_of_several_cut_off(place: Place) -> list[str]:
    words = photographs(*(noise(i) for i in range(3)))(place)
    for path in sorted(Path(place.work, "photos").iterdir())[:2]:
        path.write_bytes(path.read_bytes()[:900])
    return words


PLAIN = [np.full((192, 256, 3), value, np.uint8) for value in (90, 91, 92, 93)]
BLURRED = [cv2.GaussianBlur(noise(i), (0, 0), 20) for i in range(4)]
SFM = "data.sfm.features=512"

CASES: list[Case] = [
    fit(P, "one photograph", photographs(noise(0)), "photos", "one photograph"),
    fit(P, "one photograph, four times", photographs(*[noise(0)] * 4), "photos", "same photograph"),
    fit(P, "photographs of 24 pixels", photographs(*(noise(i, 24, 18) for i in range(4))), "24x18", "128"),
    fit(P, "nothing in common", lambda p: [*photographs(*map(noise, range(4)))(p), SFM], "0 of 4", "others show"),
    fit(P, "white walls", lambda p: [*photographs(*PLAIN)(p), SFM], "0 of 4", "plain surfaces"),
    fit(P, "blurred", lambda p: [*photographs(*BLURRED)(p), SFM], "0 of 4", "blurred"),
    fit(P, "panoramas", photographs(*panoramas()), "photos", "panorama"),
    fit(P, "cut off", one_of_several_cut_off, "2 of 3 photographs cannot be read"),
    fit(P, "text", photographs(*[f"404 {i}".encode() for i in range(3)], suffix=".jpg"), "cannot be read"),
    fit(P, "empty files", photographs(b"", suffix=".jpg"), "photos"),
    fit(P, "raw files", photographs(b"II*\0raw", suffix=".dng"), "is no capture"),
    fit(P, "data.sfm.pairs that is not known", ["data.sfm.pairs=all"], "data.sfm.pairs"),
    fit(P, "data.sfm.model that is not known", ["data.sfm.model=PANORAMA"], "data.sfm.model"),
    fit(P, "data.sfm.photographs: 2", ["data.sfm.photographs=2"], "data.sfm.photographs"),
    fit(P, "data.sfm.step: 0", ["data.sfm.step=0"], "data.sfm.step"),
    fit(P, "data.sfm as a number", ["data.sfm=3"], "data.sfm"),
    fit(V, "an empty file", lambda p: [f"data.source={p.write('walk.mp4', b'').name}"], "walk.mp4", "damaged"),
    fit(V, "another file", lambda p: [f"data.source={p.write('walk.mov', b'404' * 99).name}"], "walk.mov", "damaged"),
    fit(V, "a video that is cut off", video([noise(0)] * 9, 0.4), "walk.mp4", "damaged"),
    fit(V, "a video that stands still", video([noise(0)] * 25), "walk.mp4", "stands still"),
    fit(V, "a video of one frame", video([noise(0)]), "walk.mp4", "too short"),
]
