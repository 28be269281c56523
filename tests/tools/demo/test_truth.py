"""Following a truth file while it grows, and the traction that a line of it stands for."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from resonator_daemon.tools.demo.truth import TruthLine, TruthTable, surface_traction
from simulators.contact import pixel_tractions

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


SHAPE = 20, 32
PITCH_M = 4e-4


def test_the_tractions_of_two_contacts_add_up() -> None:
    places: tuple[tuple[float, float], ...] = ((-3e-3, 1e-3), (3e-3, -1e-3))
    line = line_of(touch((0.0, 0.0, 0.3), places[0]), touch((0.05, 0.0, 0.2), places[1]))
    expected = sum(
        pixel_tractions(force, place, 2.5e-3, 0.5, SHAPE, PITCH_M)
        for force, place in zip(((0.0, 0.0, 0.3), (0.05, 0.0, 0.2)), places, strict=True)
    )
    np.testing.assert_allclose(surface_traction(line, SHAPE, PITCH_M), expected, atol=1e-9)
