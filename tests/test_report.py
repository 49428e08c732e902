"""How a comparison reads: tables of text, and the page in windows of several widths."""

import html
import re
import subprocess

import pytest
from explorer_page import BROWSER, needs_browser
from matplotlib.backends.backend_agg import FigureCanvasAgg

from agents import figures
from agents.comparison import Share, above, compare, percent, table, write
from agents.controllers import CONTROLLERS, make_controller
from agents.numerals import aligned
from agents.report import WIDTH
from roadgym.task import make_task

ENVIRONMENT = {"road": "multiplicative", "speed": (0.7, 3.0), "bandwidth": (0.1, 0.3)}
TASK = make_task(**ENVIRONMENT)
WINDOWS = (1400, 1000, 390)


@pytest.fixture(scope="module")
def comparison():
    return compare(
        make_controller("skyhook", TASK),
        environment=ENVIRONMENT,
        speeds=[1.0, 2.0],
        bandwidths=[0.1, 0.3],
        controllers=("d_min", "skyhook", "one_step_lookahead"),
        episodes=16,
    )


def widths(page, browser, tmp_path):
    """The width that the page takes in windows of several widths."""
    probe = "<script>addEventListener('load', () => document.title = document.documentElement.scrollWidth)</script>"
    frames = "".join(
        f'<iframe width="{width}" height="900" srcdoc="{html.escape(page + probe)}"></iframe>' for width in WINDOWS
    )
    titles = "[...document.querySelectorAll('iframe')].map(frame => frame.contentDocument.title)"
    tell = f"setTimeout(() => document.body.innerHTML = {titles}, 500)"
    (tmp_path / "frames.html").write_text(f"{frames}<script>addEventListener('load', () => {tell})</script>")
    options = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        f"--user-data-dir={tmp_path / 'browser'}",
        "--virtual-time-budget=9000",
    ]
    command = [browser, *options, "--dump-dom", (tmp_path / "frames.html").as_uri()]
    said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
    return [int(width) for width in re.search(r"<body>([\d,]+)", said)[1].split(",")]


@needs_browser
def test_page_fits_into_windows_of_any_width(comparison, tmp_path):
    write(comparison, tmp_path)
    assert all(
        taken <= window
        for taken, window in zip(widths((tmp_path / "comparison.html").read_text(), BROWSER, tmp_path), WINDOWS, strict=True)
    )


def test_page_says_first_what_was_found_then_how_then_numbers(comparison, tmp_path):
    write(comparison, tmp_path)
    page = (tmp_path / "comparison.html").read_text()
    order = [
        "agent closes",
        "the less it costs, the better",
        "<img",
        "D_max where the damper would brake",
        "<dt>ν</dt>",
        "<table",
    ]
    places = [page.index(words) for words in order]
    assert places == sorted(places)
    for term in ("ν", "δ", "D", "cost", "theory", "gap closed", "lower bound", "certified", "switches"):
        assert f"<dt>{term}</dt>" in page
    for name in ("skyhook", "best constant D", "one-step lookahead"):  # one name, in the list and in both tables
        assert f"<dt>{name}</dt>" in page
        assert len(re.findall(rf"<td>{name}( = [\d.]+)?</td>", page)) == 2 * len(comparison.points)


def test_page_and_picture_have_the_lower_bound(comparison, tmp_path, monkeypatch):
    drawn = {}
    monkeypatch.setattr(figures, "save_figure", lambda figure, path: drawn.update({path.stem: figure}))
    figures.draw_cost_over_speed(comparison, tmp_path / "costs.png")
    for axis, bandwidth in zip(drawn["costs"].axes, (0.1, 0.3), strict=True):
        (line,) = (line for line in axis.get_lines() if line.get_label() == "lower bound of all controllers")
        known = [
            bound.cost
            for point, bound in zip(comparison.points, comparison.bounds, strict=True)
            if point.bandwidth == bandwidth
        ]
        assert line.get_ydata().tolist() == known
        lowest = axis.get_ylim()[0]
        assert lowest > 0
        assert lowest < min(row.cost for row in comparison.rows)
    monkeypatch.undo()
    write(comparison, tmp_path)
    page = (tmp_path / "comparison.html").read_text()
    shown = re.findall(r'<td>lower bound</td><td class="number"> *([\d.]+) *</td>', page)
    assert [float(cell) for cell in shown] == pytest.approx([bound.cost for bound in comparison.bounds], abs=1e-4)
    assert page.index("Certified: agent saves at least") < page.index("<table")


def test_legends_cover_no_marks(comparison, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "save_figure", lambda figure, path: drawn.append(figure))
    for narrow in (False, True):
        figures.draw_cost_over_speed(comparison, tmp_path, narrow=narrow)
    for figure in drawn:
        FigureCanvasAgg(figure).draw()
        (legend,) = figure.legends
        assert not any(
            axis.get_legend() or legend.get_window_extent().overlaps(axis.get_window_extent()) for axis in figure.axes
        )
    assert drawn[1].get_figwidth() < drawn[1].get_figheight()


def test_pictures_for_a_phone_are_narrow_and_say_the_same(comparison, tmp_path, monkeypatch):
    drawn = {}
    monkeypatch.setattr(figures, "save_figure", lambda figure, path: drawn.update({path.stem: figure}))
    cost, policy = figures.draw_figures(comparison, tmp_path)[:2]
    for picture in (cost, policy):
        wide, narrow = drawn[picture.path.stem], drawn[picture.narrow.stem]
        assert narrow.get_figwidth() <= 4.2 < wide.get_figwidth()  # a phone shows it in about 390 pixels
        said, expected = (
            {words for axis in figure.axes for words in (axis.get_xlabel(), axis.get_ylabel(), axis.get_title())}
            for figure in (narrow, wide)
        )
        assert said == expected
    panels = drawn[policy.narrow.stem].axes[:-1]
    assert len({axis.get_subplotspec().colspan.start for axis in panels}) == 2


def test_table_reads_in_a_terminal_of_80_columns():
    agents = {name: [make_controller("skyhook", TASK)] for name in ("runs/a", "x" * 40)}
    rules = [name for name in CONTROLLERS if name not in ("groundhook", "hybrid")]  # which need a wheel
    found = compare(agents, environment=ENVIRONMENT, speeds=[1.0, 1.5], bandwidths=[0.1], controllers=rules, episodes=16)
    text = table(found)
    assert max(map(len, text.splitlines())) <= WIDTH == 80
    lines = text.splitlines()
    heads = [line for line in lines if line.lstrip().startswith("nu ")]
    assert len(heads) > 1
    labels = {label for head in heads for label in re.split(r"  +", head.strip())}
    assert labels == {"nu", "delta", "cost", "gap closed", "certified", "D", "theory"}
    for label in (*labels, "runs/a", "lower bound"):  # each is explained, and nothing else is
        assert any(line.startswith(f"{label}: ") for line in lines)
    assert "gain" not in text


def test_numbers_stand_with_their_decimal_points_under_each_other():
    cells = aligned(["34.9(10)", "0.7958(29)", "1", "-3.5 ±1.0 %", "n/a"])
    assert len({len(cell) for cell in cells}) == 1
    assert len({cell.index(".") for cell in cells if "." in cell}) == 1
    assert cells[2].rstrip() == " 1"


def test_losses_beyond_all_that_is_at_stake_are_no_number():
    assert percent(Share(-63.389, -64, -62)) == "< -100 %"
    assert percent(Share(0.957, 0.95, 0.964)) == "95.7 ±0.7 %"
    assert above(Share(63.0, 62, 64)) == "64 times"


def test_table_without_agents_and_bandwidth_explains_what_is_there():
    found = compare(None, environment={"road": "harmonic", "speed": (0.7, 3.0)}, speeds=[1.0, 1.5], episodes=16)
    lines = table(found).splitlines()
    head = next(number for number, line in enumerate(lines) if line.startswith(" nu "))
    assert [line.split()[0] for line in lines[head : head + 4]] == ["nu", lines[head + 1], "1", "1.5"]
    explained = {line.partition(":")[0] for line in lines if re.match(r"[a-zA-Z][a-zA-Z ]*: ", line)}
    assert explained == {"nu", "D", "cost", "theory", "lower bound", "less noise"}


def test_where_no_bound_is_known_the_table_says_why():
    noisy = {"road": "harmonic", "speed_noise": "white", "speed": (0.7, 3.0)}
    text = " ".join(table(compare(None, environment=noisy, speeds=[1.0], episodes=16)).split())
    assert "certified: n/a here for lack of a lower bound: white noise on the speed." in text
    assert "lower bound:" not in text.replace("a lower bound:", "")
    silent = compare(None, environment=noisy, speeds=[1.0], episodes=16, bound="none")
    assert "certified" not in table(silent)
