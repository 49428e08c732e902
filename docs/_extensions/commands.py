"""`.. commands::` lists every command of the command line with its help, from the parser itself."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from unittest import mock

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from agents import cli


class Commands(SphinxDirective):
    """One section for each command."""

    def run(self) -> list[nodes.Node]:
        """The sections."""
        for file in Path(cli.__file__).parent.glob("*.py"):
            self.env.note_dependency(str(file))
        actions = cli.make_parser()._actions
        (commands,) = (action for action in actions if isinstance(action, argparse._SubParsersAction))
        sections: list[nodes.Node] = []
        for name, command in _with_parts(commands.choices):
            section = nodes.section(ids=[f"roadgym-{name.replace(' ', '-')}"], names=[f"roadgym {name}"])
            section += nodes.title("", f"roadgym {name}")
            with mock.patch.dict(os.environ, {"COLUMNS": "100", "NO_COLOR": "1"}):
                text = command.format_help()
            section += nodes.literal_block(text, text, language="text")
            sections.append(section)
        return sections


def _with_parts(commands: Mapping[str, argparse.ArgumentParser]) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Every command and its name, each followed by the commands that it is made of."""
    for name, command in commands.items():
        yield name, command
        for action in command._actions:
            if isinstance(action, argparse._SubParsersAction):
                yield from ((f"{name} {part}", parser) for part, parser in action.choices.items())


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
