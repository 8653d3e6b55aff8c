"""A griffe extension: the comment behind a field is its documentation, and docstrings are plain text."""

from __future__ import annotations

import re
from typing import Any

from griffe import Attribute, Docstring, Extension, Object

BEHIND = re.compile(r"\S\s*  # (.*)$")
BELOW = re.compile(r"^\s+# (.*)$")
CODE_OR_MARK = re.compile(r"(`[^`]*`)|([<_*])")


def readable(text: str) -> str:
    """Markdown in which "<", "_" and "*" outside of code are characters."""
    return CODE_OR_MARK.sub(lambda found: found[1] or f"&#{ord(found[2])};", text)


class Comments(Extension):
    """Give attributes of classes that have no docstring the comment at their last line, and the lines that go on."""

    def on_attribute_instance(self, *, attr: Attribute, **_: Any) -> None:
        """Called by griffe for each attribute."""
        if attr.docstring or attr.endlineno is None or not attr.parent.is_class:
            return
        lines = attr.lines_collection[attr.filepath]
        first = BEHIND.search(lines[attr.endlineno - 1])
        if not first:
            return
        words = [first[1]]
        for line in lines[attr.endlineno :]:
            if not (more := BELOW.match(line)):
                break
            words.append(more[1])
        attr.docstring = Docstring(readable(" ".join(words)), parent=attr)

    def on_instance(self, *, obj: Object, **_: Any) -> None:
        """Called by griffe for each object, before what is about attributes alone."""
        if obj.docstring:
            obj.docstring.value = readable(obj.docstring.value)
