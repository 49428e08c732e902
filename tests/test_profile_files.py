"""Measured profiles from files: formats, units, and what is wrong with a bad file in one line."""

import numpy as np
import pytest

import roadgym
from roadgym import ParameterError
from roadgym.parameters import RANGES
from roadgym.roads.profile_files import read_profile

SPACING = 0.25
HEIGHTS = 0.01 * np.random.default_rng(0).standard_normal(40).cumsum()
DISTANCE = 478 + SPACING * np.arange(len(HEIGHTS))


def write(tmp_path, text, name="profile.csv"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def table(separator=",", header="", distance=DISTANCE, heights=HEIGHTS):
    rows = (f"{x:.6f}{separator}{z:.8f}" for x, z in zip(distance, heights, strict=True))
    return header + "\n".join(rows) + "\n"


@pytest.mark.parametrize("separator", [",", ";", "\t", " ", ", ", "   ", " ;  "])
@pytest.mark.parametrize("header", ["", "distance,height\n", "# measured in May\ndistance\theight\n\n", "\ufeff"])
def test_tables_between_all_separators_with_and_without_header(tmp_path, separator, header):
    profile = read_profile(write(tmp_path, table(separator, header)))
    np.testing.assert_allclose(profile.distance, DISTANCE, atol=1e-6)
    np.testing.assert_allclose(profile.heights, HEIGHTS, atol=1e-8)
    assert profile.spacing == pytest.approx(SPACING)
    assert profile.heights.dtype == profile.distance.dtype == np.float64


def test_a_comma_beside_a_semicolon_is_a_decimal_point(tmp_path):
    text = table(";", "Strecke [m];Höhe [mm]\n", heights=1000 * HEIGHTS).replace(".", ",")
    np.testing.assert_allclose(read_profile(write(tmp_path, text)).heights, HEIGHTS, atol=1e-8)


@pytest.mark.parametrize(
    "header", ["distance [m], height [mm]\n", "# x (m), z ( MM )\n", "s [m] , left wheel track [mm]\n", "x [furlong], z [mm]\n"]
)
def test_units_of_a_header_are_converted(tmp_path, header):
    profile = read_profile(write(tmp_path, table(",", header, heights=1000 * HEIGHTS)))
    np.testing.assert_allclose(profile.heights, HEIGHTS, atol=1e-8)
    assert profile.spacing == pytest.approx(SPACING)


def test_units_of_a_header_between_blanks(tmp_path):
    text = table(" ", "distance [ft] height [in]\n", distance=DISTANCE / 0.3048, heights=HEIGHTS / 0.0254)
    profile = read_profile(write(tmp_path, text))
    np.testing.assert_allclose(profile.heights, HEIGHTS, atol=1e-8)
    assert profile.spacing == pytest.approx(SPACING)


def test_units_that_are_given_count_before_those_of_the_header(tmp_path):
    path = write(tmp_path, table(",", "distance [m], height [m]\n", heights=1000 * HEIGHTS))
    np.testing.assert_allclose(read_profile(path, "mm").heights, HEIGHTS, atol=1e-8)
    path = write(tmp_path, table(distance=1000 * DISTANCE, heights=1000 * HEIGHTS))
    assert read_profile(path, units=("mm", "mm")).spacing == pytest.approx(SPACING)


def test_a_column_of_several(tmp_path):
    rows = "\n".join(f"{x},{z},{2 * z}" for x, z in zip(DISTANCE, HEIGHTS, strict=True))
    path = write(tmp_path, "x [m], left [m], right [mm]\n" + rows.replace("\n", ",\n"))
    np.testing.assert_allclose(read_profile(path, column=1).heights, HEIGHTS)
    np.testing.assert_allclose(read_profile(path, column=2).heights, 2 * HEIGHTS / 1000)
    np.testing.assert_allclose(read_profile(path, column=2, units="m").heights, 2 * HEIGHTS)


def erd(form=5, header="UNITSNAMmm      mm      \nXUNITS  m\n", samples=40, end="END\n"):
    layout = f"     2,  {samples},   -1,  1,  {form},  {SPACING:.4f},  -1,\n"
    rows = "\n".join(f" {1000 * z:.5f} {2000 * z:.5f}" for z in HEIGHTS)
    return f"ERDFILEV2.00\n{layout}TITLE   Section 7, run 1\n{header}{end}{rows}\n"


def test_erd(tmp_path):
    path = write(tmp_path, erd(), "section.erd")
    profile = read_profile(path)
    np.testing.assert_allclose(profile.heights, HEIGHTS, atol=1e-8)
    np.testing.assert_allclose(profile.distance, DISTANCE - DISTANCE[0])
    np.testing.assert_allclose(read_profile(path, column=2).heights, 2 * HEIGHTS, atol=1e-8)
    feet = read_profile(write(tmp_path, erd(header="UNITSNAMmm      mm      \nXUNITS  ft\n")))
    assert feet.spacing == pytest.approx(SPACING * 0.3048)


def crg(form="LRFI", sections="D:long section 1,m\nD:long section 2,m\nD:long section 3,m\n", extra="", ends="$$$$\n"):
    return (
        "$CT\nan example ! with a comment\n$\n$ROAD_CRG\n* grid\nREFERENCE_LINE_INCREMENT = 0.25 ! m\n"
        f"LONG_SECTION_V_RIGHT = -0.5\nLONG_SECTION_V_INCREMENT = 0.5\n$\n{extra}$KD_Definition\n#:{form}\n"
        f"U:reference line u,m,0,0.25\nD:reference line phi,rad\n{sections}$\n{ends}"
    )


def grid():
    """Columns: heading, and three long sections."""
    return np.stack([0 * HEIGHTS, HEIGHTS, 2 * HEIGHTS, 3 * HEIGHTS], axis=1)


def test_opencrg_as_text(tmp_path):
    rows = "\n".join("".join(f"{number:10.6f}" for number in row) for row in grid())
    path = write(tmp_path, crg() + rows.replace("  0.000000", "*missing**", 1) + "\n", "road.crg")
    profile = read_profile(path)  # in the middle
    np.testing.assert_allclose(profile.heights, 2 * HEIGHTS, atol=1e-6)
    assert profile.spacing == 0.25
    np.testing.assert_allclose(read_profile(path, column=1).heights, HEIGHTS, atol=1e-6)


def test_opencrg_as_text_over_several_lines(tmp_path):
    sections = "".join(f"D:long section at v = {v},m\n" for v in (-2.0, -1.5, -1.0, -0.5, 0.25, 0.5, 1.0, 2.0))
    rows = np.outer(HEIGHTS, np.arange(9))
    text = "".join("".join(f"{x:10.6f}" for x in row[:8]) + "\n" + f"{row[8]:10.6f}" + "\n" for row in rows)
    path = write(tmp_path, crg(sections=sections) + text)
    np.testing.assert_allclose(read_profile(path).heights, 5 * HEIGHTS, atol=1e-6)  # at v = 0.25
    np.testing.assert_allclose(read_profile(path, column=8).heights, 8 * HEIGHTS, atol=1e-6)


@pytest.mark.parametrize(("form", "kind"), [("KRBI", ">f4"), ("KDBI", ">f8")])
@pytest.mark.parametrize("rows", [38, 39, 40])
def test_opencrg_in_binary_with_its_last_record_filled_up(tmp_path, form, kind, rows):
    payload = grid()[:rows].astype(kind).tobytes()
    payload += np.full(-(len(payload) % -80) // int(kind[2]), np.nan, kind).tobytes()
    profile = read_profile(write(tmp_path, crg(form).encode() + payload, "road.crg"))
    np.testing.assert_allclose(profile.heights, 2 * HEIGHTS[:rows], atol=1e-7)


def uneven(place, by):
    moved = DISTANCE.copy()
    moved[place:] += by
    return moved


MILLIMETRES = 1000 * 0.0036 * np.sqrt(SPACING) * np.random.default_rng(1).standard_normal(200).cumsum()
TEXT_ROWS = "\n".join("".join(f"{number:10.6f}" for number in row) for row in grid()) + "\n"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "it is empty"),
        (b" \n\n", "it is empty"),
        (bytes(range(256)), "it is binary"),
        (table().encode("utf-16"), "it is binary"),
        ("a letter to nobody\n" * 60, "must have two columns of numbers"),
        ("\n".join(map(str, HEIGHTS)), "two columns, distance and height, got"),
        (table() + "nothing,here\n" + table(), "line 41 of the profile .* must have numbers, got 'nothing,here'"),
        (table(header="x, z\n") + "500\n", "line 42 of the profile .* must have numbers, got '500'"),
        (table().replace(f"{HEIGHTS[6]:.8f}", "nan"), "height 7 of the profile .* must be finite, got nan"),
        (table().replace(f"{DISTANCE[6]:.6f}", "inf"), "distance 7 of the profile .* must be finite, got inf"),
        (table().replace(f"{HEIGHTS[6]:.8f}", "1e300"), r"height 7 of .* must lie within \[-10000, 10000\] m, got 1e\+300 m"),
        (table().replace(f"{DISTANCE[6]:.6f}", "-1e308"), r"distance 7 of .* must lie within \[-1e\+09, 1e\+09\] m, got -1e"),
        (table(header="x [m], z [km]\n").replace(f"{HEIGHTS[6]:.8f}", "9e307"), "height 7 of .* must be finite, got inf"),
        (table(distance=DISTANCE[::-1]), "must grow, got 487.5 after 487.75 at point 2"),
        (table(distance=uneven(10, -SPACING)), "must grow, got 480.25 after 480.25 at point 11"),
        (table(distance=uneven(10, 0.1)), r"even to 0.05 of a step: from 480.25 m to 480.6 m it is 0.35 m, elsewhere 0.25 m"),
        (table(distance=DISTANCE[:10], heights=HEIGHTS[:10]), "at least 16 points, got 10"),
        (table(distance=1000 * DISTANCE), r"spacing .* must lie within \[0.001, 10\] m, got 250 m; units tells"),
        (table(distance=SPACING * np.arange(200), heights=MILLIMETRES), "no road does: units must tell their unit"),
        ("\n".join(f"{x},{z},{z}" for x, z in zip(DISTANCE, HEIGHTS, strict=True)), "has 3 columns: column must tell"),
        (erd(form=1), r"as text \(form 5 of ERD\), got the form 1"),
        (erd(samples=-1), "must have the layout of ERD"),
        ("ERDFILEV2.00\nwhat is this\nEND\n", "must have the layout of ERD"),
        (erd(end=""), "must have the line END"),
        (erd(samples=41), "41 samples of 2 channels that it tells, got 80 numbers"),
        (erd(samples=10**7), "at most 1000000 points, got 10000000"),
        (erd().replace(f"{1000 * HEIGHTS[3]:.5f}", "many"), "must have numbers after END"),
        (crg(ends="") + TEXT_ROWS, r"must have a line that begins with \$\$"),
        (crg(sections="") + TEXT_ROWS, "must define a long section"),
        (crg().replace("REFERENCE_LINE_INCREMENT", "INCREMENT") + TEXT_ROWS, "must have a REFERENCE_LINE_INCREMENT"),
        (crg(extra="$ROAD_CRG_MODS\nSCALE_Z_GRID = 2\n$\n") + TEXT_ROWS, "has the modifier SCALE_Z_GRID"),
        (crg(extra="$ROAD_CRG_FILE\nother.crg\n$\n") + TEXT_ROWS, "refers to another file"),
        (crg(form="LAFI") + TEXT_ROWS, "must have its numbers as LRFI, LDFI, KRBI, KDBI, got 'LAFI'"),
        (crg() + TEXT_ROWS.replace("  0.000000", "   nothing", 1), "row 1 of the numbers .* must be 4 numbers"),
        (crg() + TEXT_ROWS.replace(f"{2 * HEIGHTS[2]:10.6f}", "*missing**", 1), "height 3 .* must be finite"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, content, told):
    with pytest.raises(ParameterError, match=told) as error:
        read_profile(write(tmp_path, content))
    assert "\n" not in str(error.value)


def test_no_file_and_a_folder(tmp_path):
    with pytest.raises(ParameterError, match=r"cannot read the profile .*nowhere\.csv': No such file"):
        read_profile(tmp_path / "nowhere.csv")
    with pytest.raises(ParameterError, match="it is a folder"):
        read_profile(tmp_path)
    with pytest.raises(ParameterError, match="path must name a file, got None"):
        read_profile(None)


@pytest.mark.parametrize("units", ["furlong", ("m",), ("m", "m", "m"), 3, ("m", 5), "km", ("m", "km")])
def test_units_that_nobody_knows(tmp_path, units):
    with pytest.raises(ParameterError, match="units must be that of heights, or a pair"):
        read_profile(write(tmp_path, table()), units)


@pytest.mark.parametrize(
    ("content", "column", "told"),
    [
        (table(), 2, "column must be at most 1"),
        (erd(), 3, "column must be at most 2"),
        (crg() + TEXT_ROWS, 4, "column must be at most 3"),
        (table(), 0, "column must be at least 1"),
    ],
)
def test_a_column_that_is_not_there(tmp_path, content, column, told):
    with pytest.raises(ParameterError, match=told):
        read_profile(write(tmp_path, content), column=column)


def test_suspicious_heights_are_read_where_their_unit_is_told(tmp_path):
    path = write(tmp_path, table(distance=SPACING * np.arange(200), heights=MILLIMETRES))
    np.testing.assert_allclose(read_profile(path, "mm").heights, MILLIMETRES / 1000, atol=1e-10)
    np.testing.assert_allclose(read_profile(path, "m").heights, MILLIMETRES, atol=1e-7)


@pytest.mark.parametrize("spacing", [0.01, 0.25, 5.0])
@pytest.mark.parametrize("iso_class", "ACH")
def test_roads_of_all_classes_are_believed_in_metres_and_not_in_millimetres(tmp_path, spacing, iso_class):
    distance, (heights,) = roadgym.sample_road(f"iso_{iso_class.lower()}", spacing=spacing, points=400, seed=3)
    path = write(tmp_path, table(distance=distance, heights=300 + heights))
    np.testing.assert_allclose(read_profile(path).heights, 300 + heights, atol=1e-7)
    with pytest.raises(ParameterError, match="units must tell"):
        read_profile(write(tmp_path, table(distance=distance, heights=1000 * heights)))


def test_distances_that_a_file_rounds(tmp_path):
    distance = 0.1524 * np.arange(500)
    heights = np.interp(distance, DISTANCE - DISTANCE[0], HEIGHTS)
    profile = read_profile(write(tmp_path, "\n".join(f"{x:.3f} {z}" for x, z in zip(distance, heights, strict=True))))
    assert profile.spacing == pytest.approx(0.1524, rel=1e-4)


def test_no_more_of_a_long_file_is_read_than_is_allowed(tmp_path):
    path, most = tmp_path / "long.csv", int(RANGES["profile points"].high)
    with path.open("w") as file:
        file.writelines(f"{k}.0,0\n" for k in range(most + 1))
        file.write("and this is never read\n")
    with pytest.raises(ParameterError, match="at most 1000000 points"):
        read_profile(path)
