r"""Equations as MathML, which browsers draw themselves: no script, no network. `\tag{16}` puts the number at the right."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util import logging

logger = logging.getLogger(__name__)


def mathml(latex: str, node: nodes.Element, display: str) -> str:
    """MathML of a formula; what the converter does not know it leaves as TeX, which is warned of."""
    result = convert(latex, display=display).replace("<mi>&#x000B1;</mi>", "<mo>&#x000B1;</mo>")  # +- is an operator
    if unknown := re.findall(r"<mi>(\\\w+|&)</mi>", result):
        logger.warning("no MathML for %s in %r", ", ".join(unknown), latex, location=node)
    return result


def visit_inline(self: Any, node: nodes.math) -> None:
    """A formula in a line of text."""
    self.body.append(mathml(node.astext(), node, "inline"))
    raise nodes.SkipNode


def visit_block(self: Any, node: nodes.math_block) -> None:
    """A formula of its own, with its number."""
    latex, tag = node.astext(), ""
    if found := re.search(r"\\tag\{(.*?)\}", latex):
        latex, tag = latex.replace(found[0], ""), f'<span class="eqno">({found[1]})</span>'
    self.body.append(f'<div class="equation">{mathml(latex, node, "block")}{tag}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer "mathml"."""
    app.add_html_math_renderer("mathml", inline_renderers=(visit_inline, None), block_renderers=(visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
