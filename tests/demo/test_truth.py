"""Following a truth file while it grows, and the traction that a line of it stands for."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from resonator_daemon.demo.truth import TruthLine, TruthTable, site_traction, surface_traction

T0_NS = 1_789_000_000_000_000_123


def text_of(number: int, *contacts: dict[str, Any]) -> str:
    line = {
        "sequence": 40 + number,
        "board_ticks": 5000 + 1000 * number,
        "t_ns": str(T0_NS + 1_000_000 * number),
        "contacts": list(contacts),
        "plate_kelvin": 298.4,
    }
    return json.dumps(line) + "\n"


def touch(force_newton: tuple[float, float, float], position_m: tuple[float, float] = (0.0, 0.0)) -> dict[str, Any]:
    return {"id": 1, "site": 7, "position_m": list(position_m), "force_newton": list(force_newton), "radius_m": 0.0025}


def line_of(*contacts: dict[str, Any]) -> TruthLine:
    return TruthLine(sequence=1, board_ticks=1, t_ns=1, contacts=contacts)


def append(path: Path, text: str) -> None:
    with path.open("a") as file:
        file.write(text)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "truth.jsonl"


@pytest.fixture
def table(path: Path) -> Iterator[TruthTable]:
    table = TruthTable(path)
    yield table
    table.close()


@pytest.mark.parametrize("piece", [1, 7, 100, 10_000])
def test_a_file_that_grows_by_pieces_of_lines_is_read_once(path: Path, table: TruthTable, piece: int) -> None:
    whole = "".join(text_of(number, touch((0.0, 0.0, 0.25 * number))) for number in range(20))
    for start in range(0, len(whole), piece):
        append(path, whole[start : start + piece])
        table.read_on()
        assert len(table.lines) == whole[: start + piece].count("\n")
    table.read_on()
    assert [line.board_ticks for line in table.lines] == [5000 + 1000 * number for number in range(20)]
    assert [line.contacts[0]["force_newton"][2] for line in table.lines] == [0.25 * number for number in range(20)]


SHAPE = NY, NX = 20, 32
PITCH_M = 4e-4
FRICTION = 0.5


def partial_slip(force_newton: tuple[float, float, float], x_m: float, y_m: float) -> NDArray[np.float64]:
    """Cattaneo and Mindlin's tractions (3, ny, nx), averaged over pixels by 24 x 24 points in each."""
    f_x, f_y, f_z = force_newton
    a = 2.5e-3 * f_z ** (1 / 3)
    p_0 = 3 * f_z / (2 * math.pi * a**2)
    shear = math.hypot(f_x, f_y)
    c = a * (1 - shear / (FRICTION * f_z)) ** (1 / 3)
    points = 24
    x = ((np.arange(NX * points) + 0.5) / points - NX / 2) * PITCH_M - x_m
    y = ((np.arange(NY * points) + 0.5) / points - NY / 2) * PITCH_M - y_m
    r2 = x**2 + y[:, None] ** 2
    pressure = p_0 * np.sqrt(np.maximum(1 - r2 / a**2, 0.0))
    stuck = FRICTION * p_0 * c / a * np.sqrt(np.maximum(1 - r2 / c**2, 0.0))
    sheared = FRICTION * pressure - stuck
    if shear == 0.0:
        sheared, shear = np.zeros_like(sheared), 1.0
    fine = np.array([sheared * f_x / shear, sheared * f_y / shear, pressure])
    averaged: NDArray[np.float64] = fine.reshape(3, NY, points, NX, points).mean(axis=(2, 4))
    return averaged


def test_the_tractions_of_two_contacts_add_up() -> None:
    places: tuple[tuple[float, float], ...] = ((-3e-3, 1e-3), (3e-3, -1e-3))
    line = line_of(touch((0.0, 0.0, 0.3), places[0]), touch((0.05, 0.0, 0.2), places[1]))
    expected = partial_slip((0.0, 0.0, 0.3), *places[0]) + partial_slip((0.05, 0.0, 0.2), *places[1])
    np.testing.assert_allclose(surface_traction(line, SHAPE, PITCH_M), expected, atol=2e-3 * expected[2].max())


def test_at_points_the_traction_is_what_its_mean_over_small_pixels_tends_to() -> None:
    line = line_of(touch((0.2, -0.1, 0.8), (1.7e-3, -0.6e-3)), touch((0.0, 0.0, 0.3), (-2e-3, 1e-3)))
    fine_m = 2e-5
    x, y = np.meshgrid((np.arange(500) - 249.5) * fine_m, (np.arange(400) - 199.5) * fine_m)
    pixels = surface_traction(line, (400, 500), fine_m).reshape(3, -1)
    points = site_traction(line, np.stack([x, y], axis=-1).reshape(-1, 2))
    assert np.linalg.norm(points - pixels) < 4e-3 * np.linalg.norm(pixels)  # but for the pixels on the rims
    assert points[2].max() > 1e4
