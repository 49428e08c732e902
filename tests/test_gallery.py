"""The commands of the gallery make its pictures."""

import itertools
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from agents import driving
from agents.cli import main, make_parser
from analysis.paper.figures import FIGURES

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "gallery.md").read_text(encoding="utf-8")
COMMANDS = [" ".join(text.split()) for text in re.findall(r"`(roadgym [^`]+)`", PAGE)]
FRAME = 250  # after 50 s, or 3.75 s of the car of two masses


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_are_understood(command):
    assert make_parser().parse_args(shlex.split(command)[1:])


def test_every_figure_is_one_that_the_command_writes():
    shown = {int(number) for number in re.findall(r"_generated/figure_(\d+)\.png", PAGE)}
    assert shown == set(FIGURES)
    assert "roadgym figures --output figures" in COMMANDS


@pytest.mark.parametrize("name", ["drive", "drive_two_mass"])
def test_drive_is_the_frame_that_is_shown(name, monkeypatch, tmp_path):
    two = name == "drive_two_mass"
    (command,) = (text for text in COMMANDS if text.startswith("roadgym drive") and ("--car two_mass" in text) == two)
    films = []
    monkeypatch.setattr(driving, "write", lambda path, film, total: films.append(next(itertools.islice(film, FRAME, None))))
    assert main([*shlex.split(command)[1:], "--output", str(tmp_path / "film.gif")]) == 0
    shown = np.asarray(Image.open(DOCS / "pictures" / f"{name}.png").convert("RGB")).astype(int)
    difference = np.abs(films[0].astype(int) - shown).mean()
    assert difference < 1.0  # fonts may differ a little
