"""A griffe extension: the comment behind a field is its documentation, and what stands in <> is no HTML."""

from __future__ import annotations

import re
from typing import Any

from griffe import Attribute, Docstring, Extension, Object

BEHIND = re.compile(r"\S\s*  # (.*)$")
BELOW = re.compile(r"^\s+# (.*)$")
CODE_OR_TAG = re.compile(r"(`[^`]*`)|<")


def readable(text: str) -> str:
    """Markdown in which "<" outside of code is a character."""
    return CODE_OR_TAG.sub(lambda found: found[1] or "&lt;", text)


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
