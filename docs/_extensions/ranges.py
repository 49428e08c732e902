"""`.. ranges::` lists what every parameter may be, from the one table that the checks use."""

from __future__ import annotations

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from roadgym import parameters


class Ranges(SphinxDirective):
    """A table of `roadgym.parameters.RANGES`."""

    def run(self) -> list[nodes.Node]:
        """The table."""
        self.env.note_dependency(parameters.__file__)
        rows = [(name, f"{each.low:g}", f"{each.high:g}", each.meaning) for name, each in parameters.RANGES.items()]
        group = nodes.tgroup(cols=4)
        group += [nodes.colspec(colwidth=width) for width in (22, 8, 8, 62)]
        head, body = nodes.thead(), nodes.tbody()
        head += self._row(("range", "from", "to", "of"))
        body += [self._row(row) for row in rows]
        group += [head, body]
        table = nodes.table()
        table += group
        return [table]

    @staticmethod
    def _row(cells: tuple[str, ...]) -> nodes.row:
        row = nodes.row()
        for cell in cells:
            entry = nodes.entry()
            entry += nodes.paragraph("", cell)
            row += entry
        return row


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("ranges", Ranges)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
