"""Run the commands of a page of the documentation, and make the pictures that they lead to again.

    python benchmarks/tutorial.py [docs/tutorial.md]

A fenced bash block is run unless a comment <!-- needs: ... --> stands before it. A comment <!-- from: FILE --> before a
picture says of which file of the runs it is made: the two columns of views that reports write, laid out side by side.
About four minutes on one core for the tutorial.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"(?:^<!-- (?P<note>.*?) -->\n)?^```bash\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL)
PICTURE = re.compile(r"^<!-- from: (?P<source>\S+) -->\n!\[.*?\]\((?P<target>\S+)\)", re.MULTILINE | re.DOTALL)
NEEDED = ("launch.py", "extension.yaml", "configs", "custom", "benchmarks")  # by commands that are run elsewhere
QUALITY = 88  # of the JPEGs


class Block(NamedTuple):
    """A fenced block of commands. note: what the comment before it says, "" without one."""

    note: str
    text: str


def blocks(page: str) -> list[Block]:
    """All bash blocks of a Markdown text, in order."""
    return [Block(match["note"] or "", match["text"]) for match in BLOCK.finditer(page)]


def script(page: str, steps: int = 0) -> str:
    """What of a page can be run anywhere, as one script. steps: length of each run, and of a resumed one twice that,
    with small pictures and masks of two views; 0: as printed."""
    text = "".join(block.text for block in blocks(page) if not block.note.startswith("needs:"))
    lines = ["set -euo pipefail", *text.replace("\\\n", " ").splitlines()]
    for i, line in enumerate(lines):
        if steps and line.startswith("python launch.py"):
            length = 2 * steps if "resume=" in line else steps
            command = line.partition("  # ")[0]
            squared = re.search(r"configs/(dc-ge|grow)\.yaml", command)
            small = "data.width=64 data.height=64 system.mask.views=2" if squared else "data.max_side=64"
            lines[i] = f"{command.rstrip()} trainer.max_steps={length} system.report.video_frames=0 {small}"
    return "\n".join(lines) + "\n"


def run(page: str, folder: Path, steps: int = 0) -> subprocess.CompletedProcess:
    """Run a page's commands in `folder`, by this Python; what they say comes back as text. steps: as of `script`."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ.get("PATH", "")))
    return subprocess.run(
        ["bash", "-c", script(page, steps)],
        cwd=folder,
        env={**os.environ, "PATH": path},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def side_by_side(picture: Image.Image, views: int = 4) -> Image.Image:
    """Lay out a column of `views` views in two columns; a picture that is wider than high stays as it is."""
    if picture.height <= picture.width * 1.2:
        return picture
    row, half = picture.height // views, views // 2
    sheet = Image.new("RGB", (2 * picture.width, half * row))
    for i in range(views):
        part = picture.crop((0, i * row, picture.width, (i + 1) * row))
        sheet.paste(part, (i // half * picture.width, i % half * row))
    return sheet


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", nargs="?", type=Path, default=ROOT / "docs" / "tutorial.md")
    args = parser.parse_args(argv)
    page = args.page.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory(prefix="tutorial-") as name:
        folder = Path(name)
        for needed in NEEDED:
            (folder / needed).symlink_to(ROOT / needed)
        done = run(page, folder)
        print(done.stdout)
        if done.returncode:
            return 1
        for match in PICTURE.finditer(page):
            target = args.page.parent / match["target"]
            target.parent.mkdir(exist_ok=True)
            with Image.open(folder / match["source"]) as picture:
                side_by_side(picture.convert("RGB")).save(target, quality=QUALITY)
            print(target)
    return 0


if __name__ == "__main__":
    sys.exit(main())
