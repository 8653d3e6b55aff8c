"""Line charts as SVG: text that a page carries along, sharp at any size and following its colours."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape

WIDTH, HEIGHT = 460, 250
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 10, 36  # room around the axes
COLOURS = 6  # classes c0 to c5 of the page's style, taken in turn

Points = Sequence[tuple[float, float]]


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """About `count` round numbers that cover [low, high], from at or below low to at or above high."""
    span = high - low if high > low else abs(low) or 1.0
    rough = span / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = power * next(m for m in (1, 2, 5, 10) if m * power >= rough * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(k * step, 12) for k in range(first, max(last, first + 1) + 1)]


def line_chart(title: str, series: Mapping[str, Points], xlabel: str = "seconds", log: bool = False) -> str:
    """A figure with one line for each series, or "" where no series has two finite points.

    log: the vertical axis is logarithmic; points at or below zero are left out.
    """
    usable = {
        name: [(x, math.log10(y) if log else y) for x, y in points if math.isfinite(y) and (y > 0 or not log)]
        for name, points in series.items()
    }
    usable = {name: points for name, points in usable.items() if len(points) > 1}
    if not usable:
        return ""
    xs, ys = zip(*(point for points in usable.values() for point in points), strict=True)
    across, up = ticks(min(0.0, *xs), max(xs)), ticks(min(ys), max(ys), 4)
    if log:
        up = list(range(math.floor(min(ys) + 1e-9), max(math.ceil(max(ys) - 1e-9), math.floor(min(ys)) + 1) + 1))
        up = up[:: math.ceil(len(up) / 6)]
    bounds = up[0], max(up[-1], max(ys))

    def place(x: float, y: float) -> tuple[float, float]:
        right = (x - across[0]) / (across[-1] - across[0])
        high = (y - bounds[0]) / (bounds[1] - bounds[0])
        return LEFT + right * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - high * (HEIGHT - TOP - BOTTOM)

    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">']
    for y in up:
        _, v = place(across[0], y)
        label = f"1e{y:d}" if log else f"{y:g}"
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{v:.1f}" y2="{v:.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{v + 4:.1f}" text-anchor="end">{label}</text>')
    for x in across:
        u, _ = place(x, up[0])
        parts.append(f'<text x="{u:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{x:g}</text>')
    parts.append(f'<text x="{(LEFT + WIDTH) / 2}" y="{HEIGHT - 4}" text-anchor="middle">{escape(xlabel)}</text>')
    for number, (name, points) in enumerate(usable.items()):
        parts.append(_line(name, [place(*point) for point in points], series[name], number % COLOURS, log))
    parts.append("</svg>")
    keys = (f'<span class="c{n % COLOURS}">{escape(name)}</span>' for n, name in enumerate(usable))
    return f"<figure><figcaption>{escape(title)}<div>{''.join(keys)}</div></figcaption>{''.join(parts)}</figure>"


def _line(name: str, places: Points, points: Points, colour: int, log: bool) -> str:
    """One line, with a dot for each point that says its value where the pointer rests on it."""
    path = " ".join(f"{u:.1f},{v:.1f}" for u, v in places)
    shown = [(x, y) for x, y in points if math.isfinite(y) and (y > 0 or not log)]
    dots = "".join(
        f'<circle cx="{u:.1f}" cy="{v:.1f}" r="2.6"><title>{escape(name)}: {y:.4g} at {x:.4g} s</title></circle>'
        for (u, v), (x, y) in zip(places, shown, strict=True)
    )
    return f'<g class="c{colour}"><polyline points="{path}"/>{dots}</g>'
