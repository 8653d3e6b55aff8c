"""A video: its sharpest frames at equal steps of the view, whose cameras are found, and kept (sfm/)."""

from __future__ import annotations

from pathlib import Path

from ..meter import Meter
from .formats import CaptureOptions, Format, Scan
from .photographs import scan
from .sfm import frames, store
from .sfm.choose import VIDEOS
from .sfm.prepare import Picture


def find(source: Path) -> Path | None:
    """`source`, where its name ends as a video's."""
    return source if source.suffix.lower() in VIDEOS and source.is_file() else None


def read(path: Path, options: CaptureOptions) -> Scan:
    """Frames and the cameras that are found for them, or were found before. Raises DataError for a video that cannot be
    decoded, that stands still, or that shows no depth."""

    def copies(folder: Path) -> tuple[list[Picture], list[str]]:
        meter = Meter("cameras: looking at the video", None, "frame")

        def tick(done: int, total: int = 0) -> None:
            meter.total = max(done, total) or None
            meter.update(done)

        try:
            track = frames.look(path, tick)
            numbers = frames.chosen(path, track, options.sfm)
        finally:
            meter.close()
        meter = Meter("cameras: taking frames", numbers[-1] + 1, "frame")
        try:
            pictures = frames.write_frames(path, numbers, folder, meter.update)
        finally:
            meter.close()
        notices = [
            f"{path}: {len(numbers)} of {track.decoded} frames are used, the sharpest at equal steps of the view"
        ]
        if track.decoded < 0.9 * track.promised:
            notices.append(f"{path}: can be decoded up to frame {track.decoded} of {track.promised}; is it damaged?")
        return pictures, notices

    return scan(store.cameras(path, [("video", store.content(path))], True, options.sfm, copies), options, [])


FORMAT = Format("a video file", find, read)
