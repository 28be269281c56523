"""Layouts, and the plate file that a plan writes, against what the plate's model reads of it."""

from pathlib import Path

import numpy as np
import pytest

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.extensions.planning.plate_file import grid_layout, read_layout


def test_a_grid_is_centred_with_half_a_pitch_around_it() -> None:
    layout = grid_layout(3, 2, 6e-3)
    expected_mm = [[-6, -3], [0, -3], [6, -3], [-6, 3], [0, 3], [6, 3]]
    np.testing.assert_allclose(layout.positions_m, 1e-3 * np.array(expected_mm), atol=1e-12)
    np.testing.assert_allclose(layout.outline_m, 1e-3 * np.array([[-9, -6], [9, -6], [9, 6], [-9, 6]]), atol=1e-12)
    assert layout.site_ids == (1, 2, 3, 4, 5, 6)


@pytest.mark.parametrize("first", ["", "x_mm,y_mm\n", "x_mm, y_mm\n\n"])
def test_positions_are_read_from_lines(tmp_path: Path, first: str) -> None:
    path = tmp_path / "sites.csv"
    path.write_text(f"{first}-6.1,4.2\n3, -5\n")
    np.testing.assert_allclose(read_layout(path).positions_m, [[-6.1e-3, 4.2e-3], [3e-3, -5e-3]])


@pytest.mark.parametrize(
    ("text", "complaints"),
    [
        ("1,2\n1,2,3\nx,y\n", ["sites.csv:2: got '1,2,3'; must be x_mm,y_mm", "sites.csv:3: got 'x,y'"]),
        ("1,2\n3,4\n1.0,2\n", ["sites.csv:3: 1.0,2 is the position of line 1 already"]),
        ("nan,1\n", ["sites.csv:1: got 'nan,1'; must be x_mm,y_mm within +-10000"]),
        ("1e5,1\n", ["within +-10000"]),
        ("\n", ["no positions; give lines of x_mm,y_mm"]),
    ],
)
def test_every_line_that_is_no_position_is_named(tmp_path: Path, text: str, complaints: list[str]) -> None:
    path = tmp_path / "sites.csv"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as refused:
        read_layout(path)
    assert len(refused.value.messages) == len(complaints)
    for message, complaint in zip(refused.value.messages, complaints, strict=True):
        assert complaint in message


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"none\.csv: cannot be read: No such file"):
        read_layout(tmp_path / "none.csv")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe1,2")
    with pytest.raises(ConfigurationError, match=r"bytes\.csv: cannot be read"):
        read_layout(tmp_path / "bytes.csv")
