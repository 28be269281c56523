"""Following a truth file while it grows, and the traction that a line of it stands for."""

from pathlib import Path

import numpy as np
import pytest
from score_run import PITCH_M, TICKS, Run, touch

from resonator_daemon.tools.demo.truth import TruthLine, TruthTable, surface_traction
from simulators.contact import pixel_tractions


@pytest.mark.parametrize("piece", [1, 7, 100, 10_000])
def test_a_file_that_grows_by_pieces_of_lines_is_read_once(tmp_path: Path, piece: int) -> None:
    path = tmp_path / "truth.jsonl"
    table = TruthTable(path)
    whole = "".join(Run.line(number, touch(0.25 * number)) for number in range(20))
    for start in range(0, len(whole), piece):
        with path.open("a") as file:
            file.write(whole[start : start + piece])
        table.read_on()
        assert len(table.lines) == whole[: start + piece].count("\n")
    table.read_on()
    table.close()
    assert [line.board_ticks for line in table.lines] == [TICKS * (number + 1) for number in range(20)]
    assert [line.contacts[0]["force_newton"][2] for line in table.lines] == [0.25 * number for number in range(20)]


SHAPE = 20, 32


def test_the_tractions_of_two_contacts_add_up() -> None:
    places: tuple[tuple[float, float], ...] = ((-3e-3, 1e-3), (3e-3, -1e-3))
    contacts = touch(0.3, position_m=places[0]), touch(0.2, shear=(0.05, 0.0), position_m=places[1])
    line = TruthLine(sequence=1, board_ticks=1, t_ns=1, contacts=contacts)
    expected = sum(
        pixel_tractions(force, place, 2.5e-3, 0.5, SHAPE, PITCH_M)
        for force, place in zip(((0.0, 0.0, 0.3), (0.05, 0.0, 0.2)), places, strict=True)
    )
    np.testing.assert_allclose(surface_traction(line, SHAPE, PITCH_M), expected, atol=1e-9)
