"""A run on one page: an HTML file that needs no other, and no network."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from torch import Tensor

from ..files import write_text
from .chart import CHART_STYLE, COLOUR_STYLE
from .pictures import to_uint8

STYLE = """
*{box-sizing:border-box}
body{margin:0;background:var(--bg);color:var(--ink);font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
main{max-width:1080px;margin:0 auto;padding:36px 20px 60px}
h1{font-size:30px;line-height:1.2;margin:0 0 4px}h2{font-size:18px;margin:36px 0 12px}
.sub{color:var(--soft);margin:0 0 22px}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(158px,1fr));gap:12px}
.tile,.card{background:var(--card);border:1px solid var(--line);border-radius:10px;padding:12px 14px;margin:0}
.tile b{display:block;font-size:24px;line-height:1.25;font-variant-numeric:tabular-nums}
.tile span{color:var(--soft);font-size:13px}
.notice{margin-top:12px}
.charts{display:grid;grid-template-columns:repeat(auto-fit,minmax(330px,1fr));gap:12px}
svg{width:100%;height:auto;display:block}
.slide{position:relative;overflow:hidden;border-radius:10px;max-width:640px;line-height:0;margin:0 auto}
.slide img{width:100%;display:block}.slide .top{position:absolute;inset:0;clip-path:inset(0 50% 0 0)}
.slide i{position:absolute;top:0;bottom:0;left:50%;width:2px;background:#fff;box-shadow:0 0 5px #0008}
.slide input{position:absolute;inset:0;width:100%;height:100%;opacity:0;margin:0;cursor:ew-resize}
.slide span{position:absolute;bottom:8px;padding:3px 8px;border-radius:6px;background:#000a;color:#fff;font-size:12px;
line-height:1.3}.slide span:nth-of-type(1){left:8px}.slide span:nth-of-type(2){right:8px}
.views{display:grid;gap:10px;margin-top:12px}
.row{display:grid;grid-auto-flow:column;grid-auto-columns:1fr;gap:8px}
.row div{font-size:12px;color:var(--soft)}.row img{width:100%;display:block;border-radius:6px}
.bar{display:flex;height:22px;border-radius:6px;overflow:hidden;margin:6px 0 10px}.bar div{background:var(--c)}
.keys span{display:inline-block;margin-right:16px;font-size:13px;color:var(--soft)}
.keys span::before{content:"";display:inline-block;width:10px;height:10px;border-radius:2px;margin-right:5px;
background:var(--c)}
.scroll{overflow-x:auto}table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums;font-size:13px}
th,td{padding:5px 10px;border-bottom:1px solid var(--line);text-align:right;white-space:nowrap}
th:first-child,td:first-child{text-align:left}thead th{color:var(--soft);font-weight:500}
tr:last-child td{border-bottom:0}tr.mean td{font-weight:600}
details{margin-top:10px}summary{cursor:pointer;font-weight:600}
pre{white-space:pre-wrap;overflow-wrap:anywhere;font:12px/1.5 ui-monospace,Menlo,Consolas,monospace;margin:10px 0 0}
"""
SCRIPT = """
document.querySelectorAll('.slide').forEach(s=>{const r=s.querySelector('input');r.oninput=()=>{
s.querySelector('.top').style.clipPath=`inset(0 ${100-r.value}% 0 0)`;s.querySelector('i').style.left=r.value+'%'}})
"""
COLOURS = 8


@dataclass(frozen=True)
class Table:
    """columns: the first one names the rows. A row whose first cell is "mean" stands out."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Page:
    """What stands on a page, from top to bottom. tiles: label to value. pictures: a row of labelled pictures in [0,1]
    for each view, of which the first two are before and after. charts: those of `chart.line_chart`.
    stages: seconds by stage. notice: what a reader must know of the figures. texts: headings to what stands below them,
    folded up."""

    title: str
    subtitle: str
    tiles: Mapping[str, str] = field(default_factory=dict)
    pictures: Sequence[Sequence[tuple[str, Float[Tensor, "H W 3"]]]] = ()
    charts: Sequence[str] = ()
    stages: Mapping[str, float] = field(default_factory=dict)
    tables: Mapping[str, Table] = field(default_factory=dict)
    texts: Mapping[str, str] = field(default_factory=dict)
    notice: str = ""

    def html(self) -> str:
        """The whole file."""
        body = [f"<h1>{escape(self.title)}</h1>", f'<p class="sub">{escape(self.subtitle)}</p>', _tiles(self.tiles)]
        body += [f'<p class="card notice">{escape(self.notice)}</p>'] if self.notice else []
        shown = [[(label, data_uri(image)) for label, image in row] for row in self.pictures]
        body += [_slider(shown[0])] if shown and len(shown[0]) > 1 else []
        if charts := [f'<div class="card">{chart}</div>' for chart in self.charts if chart]:
            body.append(f'<h2>Against run time</h2><div class="charts">{"".join(charts)}</div>')
        body += [_stages(self.stages)] if sum(self.stages.values()) > 0 else []
        body += [_views(shown)] if shown else []
        body += [f"<h2>{escape(name)}</h2>{_table(table)}" for name, table in self.tables.items()]
        folded = (
            f'<details class="card"><summary>{escape(name)}</summary><pre>{escape(text)}</pre></details>'
            for name, text in self.texts.items()
        )
        return (
            '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width,initial-scale=1">'
            f"<title>{escape(self.title)}</title><style>{COLOUR_STYLE}{STYLE}{CHART_STYLE}</style></head>\n"
            f"<body><main>{''.join([*body, *folded])}</main><script>{SCRIPT}</script></body></html>\n"
        )

    def write(self, path: Path) -> Path:
        """Write the file."""
        return write_text(path, self.html())


def data_uri(image: Float[Tensor, "H W 3"], quality: int = 90) -> str:
    """A picture in [0,1] as a JPEG inside an address."""
    _, encoded = cv2.imencode(
        ".jpg", np.ascontiguousarray(to_uint8(image)[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode("ascii")


def _tiles(tiles: Mapping[str, str]) -> str:
    cells = (f'<div class="tile"><b>{escape(v)}</b><span>{escape(k)}</span></div>' for k, v in tiles.items())
    return f'<div class="tiles">{"".join(cells)}</div>'


def _slider(row: Sequence[tuple[str, str]]) -> str:
    """Before and after of one view, one over the other."""
    (before, first), (after, second) = row[:2]
    return (
        f'<h2>Before and after</h2><div class="slide"><img src="{second}" alt=""><img class="top" src="{first}" alt="">'
        f"<i></i><span>{escape(before)}</span><span>{escape(after)}</span>"
        '<input type="range" min="0" max="100" value="50" aria-label="before and after"></div>'
    )


def _views(rows: Sequence[Sequence[tuple[str, str]]]) -> str:
    """All pictures of every view."""
    out = ['<h2>Held-out views</h2><div class="views">']
    for row in rows:
        cells = (f'<div><img src="{uri}" alt="{escape(label)}">{escape(label)}</div>' for label, uri in row)
        out.append(f'<div class="row">{"".join(cells)}</div>')
    return "".join([*out, "</div>"])


def _stages(stages: Mapping[str, float]) -> str:
    """A bar that is divided as the run's time is."""
    total = sum(stages.values())
    parts = [(n % COLOURS, name, value) for n, (name, value) in enumerate(stages.items()) if value > 0]
    bar = "".join(
        f'<div class="c{n}" style="width:{100 * v / total:.2f}%" title="{escape(k)}"></div>' for n, k, v in parts
    )
    keys = (f'<span class="c{n}">{escape(k)} {v:.1f} s, {100 * v / total:.1f} %</span>' for n, k, v in parts)
    bar = f'<div class="bar">{bar}</div><div class="keys">{"".join(keys)}</div>'
    return f'<h2>Where the time went</h2><div class="card">{bar}</div>'


def _table(table: Table) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in table.columns)
    rows = "".join(
        f"<tr{' class=mean' if row[0] == 'mean' else ''}>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>"
        for row in table.rows
    )
    return f'<div class="card scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
