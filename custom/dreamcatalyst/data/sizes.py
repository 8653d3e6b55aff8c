"""The size at which views are used, and whether memory holds it."""

from __future__ import annotations

from ..errors import DataError
from ..memory import free_memory
from .formats import CaptureOptions

LONGEST = 32766  # pixels of a view's side; OpenCV resamples no longer ones
SMALLER = "Set data.max_side or data.downscale"
DRAWN = 100  # bytes per pixel of a view at least: its render, gradients, photograph and loss in float32


def require_memory(needed: float, what: str, remedy: str) -> None:
    """Raise DataError where `needed` bytes are more than are free."""
    free = free_memory()
    if needed > free:
        raise DataError(f"{what} need {needed / 2**30:.1f} GiB, and {free / 2**30:.1f} GiB are free. {remedy}.")


def fit(width: int, height: int, options: CaptureOptions) -> tuple[tuple[int, int, int, int], int, int]:
    """The window (left, top, width, height) of an image that is shown, and the width and height it is resized to.

    Raises DataError for a size that memory does not hold."""
    window, width, height = _fit(width, height, options)
    views = f"data: views of {width}x{height} pixels"
    if max(width, height) > LONGEST:
        raise DataError(f"{views}, expected {LONGEST} a side at most. {SMALLER}.")
    require_memory(width * height * DRAWN, views, SMALLER)
    return window, width, height


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
