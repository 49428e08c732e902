"""The figures' data against the formulas, written out here once more."""

import csv
import math

import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.integrate import quad

import analysis
from agents.cli import main
from analysis.paper import figures
from analysis.paper.figures import FIGURES, write
from analysis.paper.stability_figures import stability_angles
from roadgym.parameters import ParameterError


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("figures")
    reports = []
    files = write(folder / "new" / "folder", report=lambda *state: reports.append(state))
    assert sorted(files) == sorted((folder / "new" / "folder").iterdir())
    assert reports[-1][1] == reports[-1][2]
    return folder / "new" / "folder"


def read(folder, name: str) -> dict[str, np.ndarray]:
    with (folder / f"{name}.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    columns = zip(*rows, strict=True)
    table = {}
    for title, column in zip(header, columns, strict=True):
        try:
            table[title] = np.array(column, float)
        except ValueError:
            table[title] = np.array(column)
    return table


def column(table: dict[str, np.ndarray], *words: str) -> np.ndarray:
    [title] = [title for title in table if all(word in title for word in words)]
    return table[title]


def transfer(damping: float, s):
    return (1 + 2 * damping * s) / (s**2 + 2 * damping * s + 1)


def test_every_figure_is_a_picture_with_data(folder) -> None:
    for number in FIGURES:
        picture = matplotlib.image.imread(folder / f"figure_{number:02d}.png")
        assert picture.shape[0] >= 700
        assert picture.shape[1] >= 1000
        assert picture[..., :3].std() > 0.05
        tables = sorted(folder.glob(f"figure_{number:02d}*.csv"))
        assert tables
        for table in tables:
            lengths = {len(values) for values in read(folder, table.stem).values()}
            assert len(lengths) == 1
            assert lengths.pop() > 10


def test_figure_2(folder) -> None:
    table = read(folder, "figure_02")
    nu = table["frequency ratio (1)"]
    np.testing.assert_allclose(table["axis (1)"][nu > 1], 2 - 1 / nu[nu > 1])
    np.testing.assert_allclose(table["axis (1)"][nu <= 1], nu[nu <= 1])
    assert nu[-1] == math.inf
    nu = nu[:-1]
    for damping in (0.1, 0.2):
        harmonic, random = column(table, "amplitude", f"D={damping} "), column(table, "deviation", f"D={damping} ")
        np.testing.assert_allclose(harmonic[:-1], np.abs(transfer(damping, 1j * nu)), rtol=1e-9)
        square = (2 * damping + (1 + 4 * damping**2) * nu) / (2 * damping * (1 + 2 * damping * nu + nu**2))
        np.testing.assert_allclose(random[:-1], np.sqrt(square), rtol=1e-9)
        assert harmonic[-1] == random[-1] == 0


@pytest.mark.parametrize(("number", "shape"), [(3, 3.0), (4, 0.5)])
def test_figures_3_and_4(folder, number: int, shape: float) -> None:
    joint = read(folder, f"figure_{number:02d}_joint")
    z, u, density = joint.values()
    inside = z**2 + u**2 < 0.9**2
    free = 1 - (z[inside] ** 2 + u[inside] ** 2) / 0.9**2
    np.testing.assert_allclose(density[inside], shape / (math.pi * 0.81) * free ** (shape - 1), rtol=1e-9)
    assert not density[~inside].any()
    assert density.sum() * 0.01**2 == pytest.approx(1, abs=0.03 if number == 4 else 1e-4)
    marginal = read(folder, f"figure_{number:02d}_marginal")
    if number == 4:
        np.testing.assert_allclose(column(marginal, "marginal"), 1 / 1.8)  # uniform
        np.testing.assert_allclose(column(marginal, "sinusoid"), 1 / (math.pi * np.sqrt(0.81 - marginal["level (m)"] ** 2)))
    else:
        peak = 16 / (15 * math.pi) * 3 / 0.9  # of (1 - z^2/r^2)^(5/2), whose integral is 5 pi/16 r
        np.testing.assert_allclose(peak, 16 / (5 * math.pi * 0.9))
        expected = peak * (1 - marginal["level (m)"] ** 2 / 0.81) ** 2.5
        np.testing.assert_allclose(column(marginal, "marginal"), expected, rtol=1e-9, atol=1e-12)


def test_figures_5_and_6(folder) -> None:
    damping = 0.105
    for number, limit in ((5, 0.0), (6, 2 * damping)):
        table = read(folder, f"figure_{number:02d}")
        nu = table["frequency ratio (1)"][:-1]
        for delta in (0.0, 0.05, 0.1, 0.2, 0.5):
            determinant = (nu**2 - 1) ** 2 + 4 * nu * (damping + delta * nu) * (delta + damping * nu)
            crossed = 1 + 4 * nu * (damping + delta * nu) * (delta + damping * nu) + delta * nu**3 / damping
            if number == 6:
                crossed = nu**2 * (1 + 4 * damping * nu * (delta + damping * nu) + delta * nu / damping)
            values = column(table, f"delta={delta:g} ")
            np.testing.assert_allclose(values[:-1], np.sqrt(crossed / determinant), rtol=1e-9)
            assert values[-1] == limit


@pytest.mark.statistical
def test_figure_7(folder) -> None:
    means, densities = read(folder, "figure_07_means"), read(folder, "figure_07_densities")
    off = (means["mean (1)"] - means["formula (1)"]) / means["standard error (1)"]
    assert np.all(np.abs(off) < 4.5)
    assert np.mean(off**2) == pytest.approx(1, abs=0.6)
    for form, sign in (("ito", 1), ("printed", -1)):
        for name in "AB":
            chosen = (means["form"] == form) & (means["amplitude"] == name)
            amplitude = transfer(0.1, 1j * means["frequency ratio (1)"][chosen] + sign * 0.02)
            formula = amplitude.real if name == "A" else -amplitude.imag
            np.testing.assert_allclose(means["formula (1)"][chosen], formula, rtol=1e-9, atol=1e-12)
            mine = (densities["form"] == form) & (densities["amplitude"] == name)
            density = densities["density (1)"][mine].reshape(chosen.sum(), -1)
            low, high = (densities[f"cell {end} (1)"][mine].reshape(density.shape) for end in ("from", "to"))
            mass = (density * (high - low)).sum(axis=1)
            assert np.all((mass > 0.99) & (mass < 1 + 1e-9))
            centre = (density * (high - low) * (low + high) / 2).sum(axis=1)
            np.testing.assert_allclose(centre, means["mean (1)"][chosen], atol=0.1)


def test_figure_8(folder) -> None:
    table = read(folder, "figure_08")
    nu = table["frequency ratio (1)"]
    for sigma in (0.0, 0.2, 0.3, 0.4, 0.5, 0.8, 1.0, 1.5):
        for form, sign in (("exact", 1), ("printed", -1)):
            expected = np.abs(transfer(0.1, 1j * nu + sign * sigma**2 / 2))
            np.testing.assert_allclose(column(table, form, f"sigma={sigma:g} "), expected, rtol=1e-9)


@pytest.mark.parametrize("number", [9, 10])
def test_figures_9_and_10_against_quadrature(folder, number: int) -> None:
    table = read(folder, f"figure_{number:02d}")
    own = math.sqrt(1 - 0.1**2)

    def response(t: float) -> float:
        """Impulse response of (1 + 0.2 s)/(1 + 0.2 s + s^2)."""
        return math.exp(-0.1 * t) * (0.2 * math.cos(own * t) + (1 - 0.02) / own * math.sin(own * t))

    place = 160  # nu = 0.8
    assert table["frequency ratio (1)"][place] == pytest.approx(0.8)
    cases = [(0.2, 0.1), (0.2, 5.0), *([(0.5, 0.5), (0.5, 1.0)] if number == 9 else [(0.5, 0.1), (0.5, 5.0)])]
    for sigma, corner in cases:

        def term(t: float, part, sigma: float = sigma, corner: float = corner) -> float:
            filtered = -math.expm1(-corner * t) / corner
            variance = sigma**2 * (t - filtered if number == 9 else filtered)
            return response(t) * part(0.8 * t) * math.exp(-variance / 2)

        expected = math.hypot(*(quad(term, 0, 150, args=(part,), limit=500)[0] for part in (math.cos, math.sin)))
        assert column(table, "exact", f"corner={corner:g} ", f"sigma={sigma:g} ")[place] == pytest.approx(expected, rel=1e-6)
    if number == 9:  # reference values at nu = 1
        assert column(table, "exact", "sigma=0.5 corner=1 ")[200] == pytest.approx(2.565, abs=5e-4)
        assert column(table, "closure", "sigma=0.5 corner=1 ")[200] == pytest.approx(2.444, abs=5e-4)
    else:
        nu = table["frequency ratio (1)"]
        for sigma in (0.2, 0.5):
            white = np.abs(transfer(0.1, 1j * nu - sigma**2 / 2))
            np.testing.assert_allclose(column(table, "printed", "corner=0 ", f"sigma={sigma:g} "), white, rtol=1e-9)


def peaks(table: dict[str, np.ndarray], form: str, sigma: float) -> list[float]:
    """Of Fig. 10, without noise and for the corner frequencies 0, 0.1 and 5."""
    cases = ("no noise", "corner=0", "corner=0.1", "corner=5")
    return [column(table, form, f"sigma={sigma:g} {case} ").max() for case in cases]


@pytest.mark.parametrize("number", FIGURES)
def test_series_are_told_apart_by_more_than_colour(number) -> None:
    for axis in FIGURES[number](False, None).figure.axes:
        looks = {}
        for line in axis.lines:
            if len(line.get_xdata()) > 2 and line.get_label() and not line.get_label().startswith("_"):
                look = (line.get_linestyle(), line._unscaled_dash_pattern, line.get_marker(), round(line.get_linewidth(), 3))
                assert looks.setdefault(look, line.get_color()) == line.get_color()


def test_figure_10_as_printed_does_what_the_paper_says_of_it_at_the_weaker_noise_alone(folder) -> None:
    table = read(folder, "figure_10")
    assert peaks(table, "printed", 0.2) == pytest.approx([5.12, 6.38, 7.39, 8.43], abs=0.01)  # further and further up
    assert peaks(table, "printed", 0.5) == pytest.approx([5.12, 20.0, 2.77, 3.24], abs=0.01)
    for sigma in (0.2, 0.5):
        assert max(peaks(table, "exact", sigma)) == peaks(table, "exact", sigma)[0]
    for corner in (0.1, 5.0):
        for sigma, unstable in ((0.2, False), (0.5, True)):
            noise = {"kind": "high_pass", "intensity": sigma, "corner_frequency": corner}
            matrix = analysis.moment_system(noise, damping=0.1, speed=1.0, form="printed").matrix
            assert (np.linalg.eigvals(matrix).real.max() > 0) == unstable


@pytest.mark.parametrize(("number", "damping"), [(11, 0.5), (12, 1.5)])
def test_figures_11_and_12_solve_their_equations(folder, number: int, damping: float) -> None:
    table = read(folder, f"figure_{number:02d}")
    time, delta, psi = (column(table, word) for word in ("time", "difference", "stability"))
    for path in range(int(table["path"].max()) + 1):
        t, d, p = (values[table["path"] == path] for values in (time, np.unwrap(delta), psi))
        d = np.unwrap(d)
        step = t[1] - t[0]
        middle = slice(1, -1)
        np.testing.assert_allclose(
            np.gradient(p, step)[middle], -(damping * np.sin(2 * p) + np.cos(d))[middle], atol=2e-3 if number == 12 else 5e-2
        )
        inner = (np.abs(p - math.pi / 4) < 0.6)[middle]
        np.testing.assert_allclose(
            np.gradient(d, step)[middle][inner], (np.sin(d) * (1 / np.tan(p) - np.tan(p)))[middle][inner], atol=5e-2
        )
        if number == 11:  # closed
            assert (d[-1], p[-1]) == pytest.approx((d[0], p[0]), abs=1e-9)
        else:  # from one fixed point towards the other
            slow = damping - math.sqrt(damping**2 - 1)
            assert p[-1] == pytest.approx(math.atan(slow), abs=0.01)
            assert p[0] == pytest.approx(math.atan(1 / slow), abs=0.01)
            assert abs(abs(d[-1]) - math.pi) < 0.02


def test_centres_are_the_modes() -> None:
    delta, psi = stability_angles(0.3, 0j, np.array([0.0, 1.0]))
    np.testing.assert_allclose(np.cos(delta), -0.3)
    np.testing.assert_allclose(psi, math.pi / 4)


def test_figure_13(folder) -> None:
    table = read(folder, "figure_13")
    nu = table["frequency ratio (1)"]
    for damping in (0.0, 0.9, 1.0):
        own = math.sqrt(1 - damping**2)
        np.testing.assert_allclose(column(table, "upper", f"D={damping:g} "), nu + own)
        np.testing.assert_allclose(column(table, "lower", f"D={damping:g} "), nu - own, atol=1e-12)


def test_figure_14(folder) -> None:
    table = read(folder, "figure_14")
    damping = table["damping (1)"]
    bound = np.where(damping <= 1, damping, damping - np.sqrt(np.maximum(damping**2 - 1, 0)))
    np.testing.assert_allclose(column(table, "printed, almost_sure"), bound, atol=1e-7)
    np.testing.assert_allclose(column(table, "printed, mean"), 2 * bound, atol=1e-7)
    assert np.all(column(table, "ito, almost_sure")[1:] == math.inf)
    assert np.all(column(table, "ito, mean") == math.inf)


def test_some_figures_only(tmp_path) -> None:
    files = write(tmp_path, [13, 2, 13])
    assert [file.name for file in files] == ["figure_13.csv", "figure_13.png", "figure_02.csv", "figure_02.png"]


def test_files_are_whole_or_absent(tmp_path, monkeypatch) -> None:
    write(tmp_path, [13])
    before = (tmp_path / "figure_13.png").read_bytes()

    def fail(self, path, **options):
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(Figure, "savefig", fail)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path, [13, 14])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["figure_13.csv", "figure_13.png"]
    assert (tmp_path / "figure_13.png").read_bytes() == before


def test_full_takes_all_of_the_papers_samples(monkeypatch) -> None:
    asked = []

    def simulate(road, noise, *, speed, samples, **settings):
        asked.append((len(speed), samples))
        raise ParameterError("enough")

    monkeypatch.setattr(figures, "simulate", simulate)
    for full in (True, False):
        with pytest.raises(ParameterError):
            figures.figure_7(full)
    assert asked[0] == (41, 20_000_000)
    assert asked[1][1] < 1_000_000


def test_command_line(tmp_path, capsys) -> None:
    assert main(["figures", "--only", "2", "--output", str(tmp_path)]) == 0
    assert capsys.readouterr().out.splitlines() == [str(tmp_path / "figure_02.csv"), str(tmp_path / "figure_02.png")]
    for arguments, message in (
        (["--only", "1", "--output", str(tmp_path)], "figure must be one of 2, 3, 4"),
        (["--only", "2", "--output", str(tmp_path / "figure_02.csv")], "cannot be written"),
    ):
        assert main(["figures", *arguments]) == 2
        error = capsys.readouterr().err
        assert error.startswith("roadgym figures: ")
        assert message in error
        assert len(error.splitlines()) == 1
