"""`make figures` draws what docs/research/reproduction.md shows, and the page states what it prints."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def rows(text: str) -> dict[tuple[str, ...], list[float]]:
    """Numbers of the rows of tables, by the words before them."""
    found = {}
    for line in re.findall(r"^\|(.*)\|$", text, re.MULTILINE):
        cells = [cell.strip() for cell in line.split("|")]
        numbers = [re.fullmatch(r"\d+(\.\d+)?|(\d+) of \d+", cell) for cell in cells]
        key = tuple(cell for cell, number in zip(cells, numbers, strict=True) if not number)
        found[*key, str(len(cells))] = [float(number[2] or number[0]) for number in numbers if number]
    return found


@pytest.mark.soak
def test_figures_are_drawn_and_the_page_states_what_they_print(tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, ROOT / "docs" / "figures" / "draw.py", "--folder", tmp_path],
        capture_output=True,
        text=True,
        check=True,
    )
    text = (ROOT / "docs" / "research" / "reproduction.md").read_text()
    page = " ".join(text.split())
    shown = set(re.findall(r"figures/([\w-]+\.svg)", page))
    assert {path.name for path in tmp_path.iterdir()} == shown
    assert {path.name for path in (ROOT / "docs" / "figures").glob("*.svg")} >= shown
    stick = re.search(r"differ by ([\d.]+) at most", run.stdout)
    assert stick
    assert f"within {stick[1]} of the contact radius" in page
    for name, error, rest in re.findall(
        r"(\w+) differs from closed forms by ([\d.]+), without f_y by ([\d.]+)", run.stdout
    ):
        assert f"{error} for {name}" in page
        assert rest in page

    printed, stated = rows(run.stdout), rows(text)
    assert len(printed) == 19
    for row, numbers in printed.items():  # single precision rounds in its own way on each processor
        assert stated[row] == pytest.approx(numbers, rel=0.03, abs=3e-3), row


def test_the_examples_of_the_elastic_page_run() -> None:
    page = (ROOT / "docs" / "explanation" / "elastic.md").read_text()
    program = "\n".join(re.findall(r"```python\n(.*?)```", page, re.DOTALL))
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "3 p_n / (2 E) is -1.67e-06 per pascal" in run.stdout
