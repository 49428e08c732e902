"""Docstrings as they are written here: equations set off by indentation, and names in single backticks."""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx
from sphinx.util.nodes import make_refnode


def keep_layout(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Indented passages of a docstring are equations or tables: their lines stay as they are."""
    result: list[str] = []
    before, inside = "", False
    for line in lines:
        if line.strip():
            inside = inside and line.startswith("    ")
            if line.startswith("    ") and result and not result[-1].strip() and not before.startswith((" ", "-", "..")):
                result += [".. code-block:: text", ""]
                inside = True
            before = line
        # |E C| is no substitution
        result.append(line if inside else re.sub(r"(``.*?``)|\|", lambda found: found[1] or r"\|", line))
    lines[:] = result
    if what == "property":
        lines[:0] = ["..", ""]  # a comment: napoleon takes what is before a colon in the first line for a type


def link_by_name(app: Any, env: Any, node: Any, content: Any) -> Any:
    """A name in single backticks links to what is documented under that last name; others are plain code."""
    if node["reftype"] != "obj":
        return None
    ends = "." + node["reftarget"].partition("(")[0].rpartition(".")[2]
    found = sorted((name for name in env.domains["py"].objects if name.endswith(ends)), key=len)
    if not found:
        return content
    place = env.domains["py"].objects[found[0]]
    return make_refnode(app.builder, node["refdoc"], place.docname, place.node_id, content, found[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect both."""
    app.connect("autodoc-process-docstring", keep_layout, priority=400)  # before napoleon
    app.connect("missing-reference", link_by_name)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
