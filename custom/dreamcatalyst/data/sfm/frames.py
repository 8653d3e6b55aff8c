"""Frames of a video: the sharpest ones, at equal steps of how far the view has moved."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ...errors import DataError
from ...files import replacing
from .choose import FEWEST
from .options import SfmOptions
from .prepare import QUALITY, Picture

SIDE = 480  # pixels of the longer side at which frames are looked at
RATE = 30.0  # frames per second that are looked at, at most; slower videos are looked at whole
CORNERS = 300  # points that are followed from frame to frame
FARTHER = 0.8  # quantile of the points' distances that counts: around a thing in the middle, the median stands still
REFERENCE = 0.02  # of the diagonal: when the view has moved so far, new points are taken
SURVIVE = 0.6  # or when fewer of them are left
WINDOW = 0.4  # of a step: how far from its place the sharpest frame is looked for
REPEATED = 0.25  # grey levels: frames that differ less are one frame, written twice


@dataclass(frozen=True)
class Track:
    """What was seen of a video. frames: numbers of the frames that were looked at; motion: how far the view has moved
    until each, in diagonals; sharpness: variance of the Laplacian of each. decoded: frames in all; promised: frames
    that the file says it has, 0 where it does not say."""

    frames: list[int]
    motion: list[float]
    sharpness: list[float]
    decoded: int
    promised: int


def choose_frames(motion: Sequence[float], sharpness: Sequence[float], step: float, most: int) -> list[int]:
    """Which of the frames are kept: near each multiple of `step` (larger where that would be more than `most`) of the
    motion so far, the sharpest."""
    moved, sharp = np.maximum.accumulate(np.asarray(motion, float)), np.asarray(sharpness, float)
    if not len(moved) or moved[-1] <= 0:
        return list(range(min(1, len(moved))))
    step = max(step, moved[-1] / max(most - 1, 1))
    kept = []
    for target in np.arange(math.floor(moved[-1] / step + 1e-9) + 1) * step:
        away = np.abs(moved - target)
        near = np.flatnonzero(away <= max(WINDOW * step, away.min()))
        kept.append(int(near[sharp[near].argmax()]))
    return sorted(set(kept))


def look(path: Path, tick: Callable[[int, int], None]) -> Track:
    """Look at a video's frames. tick: told how many are decoded and how many there are. Raises DataError where nothing
    can be decoded."""
    frames, motion, sharpness, decoded = [], [], [], 0
    follow, due = _Follow(), -math.inf
    with opened(path) as video:
        promised = max(0, int(video.get(cv2.CAP_PROP_FRAME_COUNT)))
        while video.grab():
            number, decoded = decoded, decoded + 1
            tick(decoded, promised)
            seconds = video.get(cv2.CAP_PROP_POS_MSEC) / 1000
            if 0 < seconds < due - 1e-3:  # 0: the file does not say when
                continue
            ok, image = video.retrieve()
            if not ok:
                break
            due = seconds + 1 / RATE
            grey = _small(image)
            frames.append(number)
            motion.append(follow(grey))
            sharpness.append(float(cv2.Laplacian(grey, cv2.CV_32F).var()))
    if not frames:
        raise DataError(f"{path}: no frame of it can be decoded. It may be damaged: does a player show it?")
    return Track(frames, motion, sharpness, decoded, promised)


class _Follow:
    """How far the view has moved since the first frame: points are followed from frame to frame, and their distance
    from where they were first seen counts, so that a hand's trembling does not add up."""

    def __init__(self) -> None:
        self.last: np.ndarray | None = None
        self.begun = self.now = np.zeros((0, 1, 2), np.float32)
        self.so_far = self.moved = 0.0
        self.taken = 0  # points at first

    def __call__(self, grey: np.ndarray) -> float:
        if self.last is None:
            self._take(grey)
        elif float(cv2.absdiff(grey, self.last).mean()) > REPEATED:
            self._follow(grey)
        return self.so_far + self.moved

    def _follow(self, grey: np.ndarray) -> None:
        """Find the points in a new frame, and take new ones where it is time."""
        count = len(self.begun)
        if count:
            now, ok, _ = cv2.calcOpticalFlowPyrLK(self.last, grey, self.now, None)  # pyright: ignore
            seen = ok.ravel() == 1
            self.begun, self.now = self.begun[seen], now[seen]
        self.last = grey
        if len(self.now):
            away = np.linalg.norm(self.now - self.begun, axis=-1)
            self.moved = float(np.quantile(away, FARTHER)) / math.hypot(*grey.shape)
        if len(self.now) < max(SURVIVE * self.taken, 8) or self.moved > REFERENCE:
            # Of a cut nothing is found again: the view counts as having moved by a whole reference.
            self.so_far += self.moved if len(self.now) >= 8 else max(self.moved, REFERENCE)
            self._take(grey)

    def _take(self, grey: np.ndarray) -> None:
        points = cv2.goodFeaturesToTrack(grey, CORNERS, 0.01, 8)
        self.begun = self.now = np.zeros((0, 1, 2), np.float32) if points is None else points.reshape(-1, 1, 2)
        self.last, self.moved, self.taken = grey, 0.0, len(self.begun)


def _small(image: np.ndarray) -> np.ndarray:
    """A frame in grey, at the size at which it is looked at."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    scale = SIDE / max(grey.shape)
    return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey


def chosen(path: Path, track: Track, options: SfmOptions) -> list[int]:
    """Numbers of the frames that are kept. Raises DataError for a video that shows too little."""
    kept = choose_frames(track.motion, track.sharpness, options.step, options.photographs)
    if len(kept) < FEWEST:
        moved = f"{track.decoded} frames, in which the view moves by {track.motion[-1]:.1%} of its diagonal"
        raise DataError(
            f"{path}: is too short or stands still: {moved}. Walk around the scene for 20 seconds and more, or set "
            f"data.sfm.step, {options.step:g}, smaller"
        )
    return [track.frames[i] for i in kept]


def write_frames(path: Path, numbers: Sequence[int], folder: Path, tick: Callable[[int], None]) -> list[Picture]:
    """Write these frames of a video into `folder`, upright as the file's rotation flag says, but for those that are
    there."""
    names = {number: f"frame_{number:06d}.jpg" for number in numbers}
    wanted = {number for number, name in names.items() if not (folder / name).is_file()}
    with opened(path) as video:
        for number in range(max(wanted) + 1 if wanted else 0):
            if not video.grab():
                raise DataError(f"{path}: ends before frame {number}, which was there a moment ago")
            tick(number + 1)
            if number in wanted:
                ok, image = video.retrieve()
                if not ok:
                    raise DataError(f"{path}: frame {number} cannot be decoded")
                with replacing(folder / names[number], ".jpg") as part:
                    cv2.imwrite(str(part), image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return [Picture(name, f"frame {number}", "video") for number, name in names.items()]


@contextmanager
def opened(path: Path) -> Iterator[cv2.VideoCapture]:
    """A video's frames, turned as its rotation flag says. Raises DataError where it cannot be opened."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # what the decoder complains of, we say
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        with path.open("rb") as file:
            empty = not file.read(1)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if empty or not video.isOpened():
            raise DataError(f"{path}: cannot be opened as a video. It may be damaged: does a player show it?")
        video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        yield video
    finally:
        video.release()
        cv2.utils.logging.setLogLevel(before)
