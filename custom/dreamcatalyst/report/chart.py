"""Line charts as SVG: text that a page carries along, sharp at any size and following its colours."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape

WIDTH, HEIGHT = 460, 250
LEFT, RIGHT, BOTTOM, GAP = 46, 10, 36, 24  # room around the axes, and between charts
LINE, LETTER = 18, 6.2  # height of a line of text and about the width of a letter
COLOURS = 6  # classes c0 to c5, taken in turn
FONT = 'font-family:system-ui,-apple-system,"Segoe UI",Roboto,sans-serif'
COLOUR_STYLE = """
:root{--bg:#f6f5f2;--card:#fff;--ink:#1d1f23;--soft:#6b6f76;--line:#e3e1dc;
--c0:#b4552d;--c1:#2f6f9f;--c2:#4d8a4a;--c3:#8a5aa8;--c4:#b08a1e;--c5:#5b6470;--c6:#99aaaa;--c7:#c4bba8}
@media(prefers-color-scheme:dark){:root{--bg:#16181c;--card:#1f2227;--ink:#e8e6e1;--soft:#9a9ea6;--line:#32363d;
--c0:#e08a5f;--c1:#74b0dc;--c2:#86c282;--c3:#c49be0;--c4:#dcb95a;--c5:#a9b1bc;--c6:#7d8f8f;--c7:#8f8674}}
.c0{--c:var(--c0)}.c1{--c:var(--c1)}.c2{--c:var(--c2)}.c3{--c:var(--c3)}.c4{--c:var(--c4)}.c5{--c:var(--c5)}
.c6{--c:var(--c6)}.c7{--c:var(--c7)}
"""
CHART_STYLE = """
svg text{fill:var(--soft);font-size:11px}svg text.title{fill:var(--ink);font-size:13px;font-weight:600}
svg .grid{stroke:var(--line)}svg circle{fill:var(--c)}
svg polyline{fill:none;stroke:var(--c);stroke-width:1.8;stroke-linejoin:round}
svg polygon{fill:var(--c);opacity:.15}
"""

Points = Sequence[tuple[float, float]]


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """About `count` round numbers that cover [low, high], from at or below low to at or above high."""
    span = high - low if high > low else abs(low) or 1.0
    rough = span / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = power * next(m for m in (1, 2, 5, 10) if m * power >= rough * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(k * step, 12) for k in range(first, max(last, first + 1) + 1)]


def line_chart(
    title: str,
    series: Mapping[str, Points],
    xlabel: str = "seconds",
    log: bool = False,
    bands: Mapping[str, tuple[Points, Points]] | None = None,
) -> str:
    """An <svg> with one line for each series, or "" where no series has two finite points.

    log: the vertical axis is logarithmic; points at or below zero are left out.
    bands: of some series, the lower and the upper edge of a band behind the line; finite, and positive where log.
    """
    usable = {
        name: [(x, y) for x, y in points if math.isfinite(y) and (y > 0 or not log)] for name, points in series.items()
    }
    usable = {name: points for name, points in usable.items() if len(points) > 1}
    if not usable:
        return ""
    high = (lambda y: math.log10(y)) if log else (lambda y: y)
    edges = {name: [*low, *reversed(up)] for name, (low, up) in (bands or {}).items() if name in usable}
    drawn = [*usable.values(), *edges.values()]
    xs, ys = zip(*((x, high(y)) for points in drawn for x, y in points), strict=True)
    across, up = ticks(min(0.0, *xs), max(xs)), (_decades if log else ticks)(min(ys), max(ys))
    key, top = _key(title, list(usable))

    def place(x: float, y: float) -> tuple[float, float]:
        right = (x - across[0]) / (across[-1] - across[0])
        share = (y - up[0]) / (max(up[-1], *ys) - up[0])
        return LEFT + right * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - share * (HEIGHT - top - BOTTOM)

    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">', key]
    for y in up:
        v = place(across[0], y)[1]
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{v:.1f}" y2="{v:.1f}"/>')
        label = f"1e{y:d}" if log else f"{y:g}"
        parts.append(f'<text x="{LEFT - 6}" y="{v + 4:.1f}" text-anchor="end">{label}</text>')
    for x in across:
        u = place(x, up[0])[0]
        parts.append(f'<text x="{u:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{x:g}</text>')
    parts.append(f'<text x="{(LEFT + WIDTH) / 2}" y="{HEIGHT - 4}" text-anchor="middle">{escape(xlabel)}</text>')
    numbered = {name: number % COLOURS for number, name in enumerate(usable)}
    for name, points in edges.items():
        corners = " ".join(f"{u:.1f},{v:.1f}" for u, v in (place(x, high(y)) for x, y in points))
        parts.append(f'<g class="c{numbered[name]}"><polygon points="{corners}"/></g>')
    for name, points in usable.items():
        parts.append(_line(name, points, [place(x, high(y)) for x, y in points], numbered[name]))
    return "".join([*parts, "</svg>"])


def _decades(low: float, high: float) -> list[int]:
    """Whole powers of ten from at or below to at or above, six at most."""
    first = math.floor(low + 1e-9)
    found = list(range(first, max(math.ceil(high - 1e-9), first + 1) + 1))
    return found[:: math.ceil(len(found) / 6)]


def _key(title: str, names: Sequence[str]) -> tuple[str, float]:
    """Title and names of the lines, and where the plot may begin below them."""
    parts, x, y = [f'<text class="title" x="0" y="{LINE - 3}">{escape(title)}</text>'], LEFT, 2 * LINE
    for number, name in enumerate(names if len(names) > 1 else ()):
        width = 16 + LETTER * len(name)
        if x > LEFT and x + width > WIDTH:
            x, y = LEFT, y + LINE
        parts.append(f'<g class="c{number % COLOURS}"><circle cx="{x + 4}" cy="{y - 4}" r="4"/></g>')
        parts.append(f'<text x="{x + 12}" y="{y}">{escape(name)}</text>')
        x += width + 8
    return "".join(parts), y + 14 if len(names) > 1 else LINE + 14


def _line(name: str, points: Points, places: Points, colour: int) -> str:
    """One line, with a dot for each point that says its value where the pointer rests on it."""
    path = " ".join(f"{u:.1f},{v:.1f}" for u, v in places)
    dots = "".join(
        f'<circle cx="{u:.1f}" cy="{v:.1f}" r="2.6"><title>{escape(name)}: {y:.4g} at {x:.4g} s</title></circle>'
        for (u, v), (x, y) in zip(places, points, strict=True)
    )
    return f'<g class="c{colour}"><polyline points="{path}"/>{dots}</g>'


def picture_file(charts: Sequence[str]) -> str:
    """Charts side by side as an SVG file of its own."""
    charts = [chart for chart in charts if chart]
    placed = (chart.replace("<svg ", f'<svg x="{i * (WIDTH + GAP)}" ', 1) for i, chart in enumerate(charts))
    size = f'width="{len(charts) * (WIDTH + GAP) + GAP}" height="{HEIGHT + 2 * GAP}"'
    box = f'viewBox="{-GAP} {-GAP} {len(charts) * (WIDTH + GAP) + GAP} {HEIGHT + 2 * GAP}"'
    sized = (chart.replace("<svg ", f'<svg width="{WIDTH}" height="{HEIGHT}" ', 1) for chart in placed)
    back = f'<rect x="{-GAP}" y="{-GAP}" width="100%" height="100%" fill="var(--card)"/>'
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} {box}><style>svg{{{FONT}}}{COLOUR_STYLE}{CHART_STYLE}</style>'
    )
    return f"{head}{back}{''.join(sized)}</svg>\n"
