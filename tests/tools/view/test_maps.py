"""Maps in characters: everything is where it is on the plate, x to the right and y downwards."""

import math

import numpy as np
import pytest
from rich.segment import Segment

from resonator_daemon.tools.view.maps import SiteMark, as_pixels, pooling, round_scale, site_map, traction_map

SQUARE_M = ((-0.01, -0.01), (0.01, -0.01), (0.01, 0.01), (-0.01, 0.01))
HOUSE_M = ((-4e-3, -8e-3), (4e-3, -8e-3), (4e-3, 3.9e-3), (0.0, 8e-3), (-4e-3, 3.9e-3))
HOUSE_SITES_M = ((-2.03e-3, -6.01e-3), (3.04e-3, -5.1e-3), (0.5e-3, 5e-3))
DARK = (68, 1, 84)
BRIGHT = (253, 231, 37)


def text_of(lines: list[list[Segment]]) -> list[str]:
    return ["".join(segment.text for segment in line) for line in lines]


def untouched(label: str, x_m: float, y_m: float) -> SiteMark:
    return SiteMark((x_m, y_m), label, None, None)


def pixels_of(lines: list[list[Segment]]) -> list[list[tuple[int, int, int]]]:
    """Colours of the pixels as drawn, the top row first."""
    rows = []
    for line in lines:
        cells = [(segment.style, letter) for segment in line for letter in segment.text]
        assert {letter for _, letter in cells} == {"▀"}
        for colours in ([style.color for style, _ in cells], [style.bgcolor for style, _ in cells]):
            rows.append([tuple(colour.triplet) for colour in colours])
    return rows


def test_sites_lie_where_they_are_on_the_plate() -> None:
    marks = [
        untouched("1", -0.0095, -0.0095),
        untouched("2", 0.0095, -0.0095),
        untouched("3", -0.0095, 0.0095),
        untouched("4", 0.0, 0.0095),
    ]
    lines = text_of(site_map(SQUARE_M, marks, 10.0, rows=12, columns_max=80))
    # 10 rows of 2 mm and 20 columns of 1 mm inside the border
    assert len(lines) == 12
    assert {len(line) for line in lines} == {22}
    assert lines[0] == lines[-1] == "·" * 22
    assert lines[1] == "·1" + " " * 18 + "2·"
    assert lines[10] == "·3" + " " * 9 + "4" + " " * 9 + "·"
    assert all(line == "·" + " " * 20 + "·" for line in lines[2:10])


def test_the_outline_is_drawn_also_where_it_is_not_convex() -> None:
    notched_m = ((0.0, 0.0), (0.02, 0.0), (0.02, 0.01), (0.01, 0.01), (0.01, 0.02), (0.0, 0.02))
    lines = text_of(site_map(notched_m, [], 10.0, rows=6, columns_max=80))
    assert lines == ["··········", "·        ·", "·        ·", "·    ·····", "·    ·    ", "······    "]


def test_bars_beside_a_touched_site_are_measured_left_and_true_right() -> None:
    def line_with(measured: float | None, true: float | None) -> str:
        marks = [SiteMark((0.0, 0.0), "12", measured, true), untouched("3", -0.009, 0.0)]
        lines = text_of(site_map(SQUARE_M, marks, 8.0, rows=12, columns_max=80))
        return next(line for line in lines if "12" in line).strip("· ").removeprefix("3").strip()

    assert line_with(8.0, 8.0) == "█12█"
    assert line_with(2.0, 0.0) == "▅12▁"  # a quarter of the force is half of the height
    assert line_with(None, 8.0) == "12█"
    assert line_with(8.0, None) == "█12"
    assert line_with(math.nan, 80.0) == "?12█"
    assert line_with(-0.001, None) == "▁12"


@pytest.mark.parametrize(("x", "y"), [(0, 0), (3, 0), (0, 5), (2, 4), (1, 1)])
def test_a_pressed_pixel_lies_where_it_is_on_the_skin(x: int, y: int) -> None:
    traction = np.zeros((6, 4))
    traction[y, x] = 1e4
    drawn = pixels_of(traction_map(traction, 1e4, 1, colours=True))
    assert len(drawn) == 6
    assert drawn[y][x] == BRIGHT
    assert sum(colour != DARK for row in drawn for colour in row) == 1


def test_pixels_outside_the_plate_are_empty() -> None:
    outside = -math.inf
    traction = np.array([[outside, 1.0, outside, 1.0], [outside, 0.0, 0.0, outside]])  # the upper row first
    (line,) = traction_map(traction, 1.0, 1, colours=True)
    cells = [(letter, segment.style) for segment in line for letter in segment.text]
    assert [letter for letter, _ in cells] == [" ", "▀", "▄", "▀"]
    assert [style.bgcolor is None for _, style in cells] == [True, False, True, True]
    assert [tuple(style.color.triplet) for _, style in cells[1:]] == [BRIGHT, DARK, BRIGHT]
    assert text_of(traction_map(traction, 1.0, 1, colours=False)) == [" = ="]


def test_unknown_pixels_are_question_marks() -> None:
    traction = np.zeros((4, 3))
    traction[3, 2] = math.nan
    for colours in (True, False):
        top, bottom = text_of(traction_map(traction, 1.0, 1, colours=colours))
        assert "?" not in top
        assert [letter == "?" for letter in bottom] == [False, False, True]


@pytest.mark.parametrize(("rows", "columns", "pool"), [(16, 32, 1), (15, 32, 2), (16, 31, 2), (5, 80, 4)])
def test_pooling_is_the_least_that_fits(rows: int, columns: int, pool: int) -> None:
    assert pooling((32, 32), rows, columns) == pool


@pytest.mark.parametrize(
    ("value", "scale"), [(1.0, 1.0), (1.01, 2.0), (4.9e4, 5e4), (5.1e4, 1e5), (0.03, 0.05), (0.0, 1.0), (math.nan, 1.0)]
)
def test_scales_are_round(value: float, scale: float) -> None:
    assert round_scale(value) == pytest.approx(scale)


def test_each_pixel_is_that_of_the_nearest_site_by_brute_force() -> None:
    values = np.array([1.0, 2.0, math.nan])
    pixels = as_pixels(values, HOUSE_M, HOUSE_SITES_M)
    assert pixels.shape == (32, 16)
    for row in range(32):
        for column in range(16):
            place = (-3.75e-3 + 0.5e-3 * column, -7.75e-3 + 0.5e-3 * row)
            under_the_roof = 1.025 * abs(place[0]) + max(place[1] - 3.9e-3, 0.0) < 4.1e-3
            nearest = min(range(3), key=lambda site: math.dist(place, HOUSE_SITES_M[site]))
            expected = values[nearest] if under_the_roof else -math.inf
            assert np.array_equal(pixels[row, column], expected, equal_nan=True), place
    assert set(pixels[np.isfinite(pixels)]) == {1.0, 2.0}
    assert np.isnan(pixels).any()


def test_an_outline_that_pixels_do_not_fill_evenly_is_covered() -> None:
    triangle = ((0.0, 0.0), (10e-3, 0.0), (0.0, 3.1e-3))
    pixels = as_pixels(np.array([5.0]), triangle, ((1e-3, 1e-3),))
    assert pixels.shape == (10, 32)
    assert np.isfinite(pixels).mean() == 0.5
