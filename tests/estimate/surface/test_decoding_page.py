"""The examples of docs/explanation/decoding.md run as they stand."""

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[3] / "docs" / "explanation" / "decoding.md"


def test_the_examples_run(capsys: pytest.CaptureFixture[str]) -> None:
    for example in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
        exec(example, {})
    map_line, contact_line = capsys.readouterr().out.splitlines()
    assert map_line.startswith("(3, 400) (3, 400) ok ")
    radius_m, f_x, f_y, f_z = map(float, re.findall(r"-?[\d.]+(?:e-?\d+)?", contact_line)[:4])
    assert radius_m == pytest.approx(1.2e-3, rel=0.02)
    assert (f_x, f_y, f_z) == pytest.approx((0.2, 0.0, 1.0), abs=0.01)
