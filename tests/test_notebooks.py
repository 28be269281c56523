"""The notebook that predicts slips: its committed output, and the same cells executed once more."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).parents[1] / "docs" / "tutorials" / "predict-slip.ipynb"
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?")
RESULTS = """
labels = data.groupby("press")["slides_soon"].sum().tolist()
print(json.dumps([slides, labels, pd.DataFrame(figures).to_dict()]))
"""


def printed(cells: list[Any]) -> str:
    return "".join("".join(output.get("text", "")) for cell in cells for output in cell.get("outputs", ()))


def test_the_committed_notebook_is_executed_and_its_text_has_the_printed_numbers() -> None:
    text = NOTEBOOK.read_text()
    cells = json.loads(text)["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    kinds = [output["output_type"] for cell in code for output in cell["outputs"]]
    assert set(kinds) == {"stream", "display_data"}
    assert len(text) < 200_000
    assert re.findall(r"(?<![\w.])/(?:tmp|root|home|work|usr)\b", text) == []
    _, run, *_ = "".join(cells[-1]["source"]).split("\n\n")
    assert len(stated := NUMBER.findall(run)) > 8
    assert set(stated) <= set(NUMBER.findall(printed(cells)))


@pytest.mark.notebook
@pytest.mark.filterwarnings("default")  # the kernel's client has its own
def test_the_notebook_predicts_slides_of_presses_that_were_held_out(tmp_path: Path) -> None:
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(NOTEBOOK, 4)
    notebook.cells.append(nbformat.v4.new_code_cell(RESULTS))
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    slides, labels, figures = json.loads(printed(notebook.cells[-1:]))
    assert slides == [True] * 10  # as the emulator answered
    assert len(labels) == 10
    assert all(4 <= count <= 6 for count in labels)  # 50 ms at 100 frames/s
    assert set(figures) == {"last margin", "straight line", "regression"}
    for figure in figures.values():
        assert figure["average precision"] > 0.5  # that of guesses is 0.04, the share of the labelled frames
        assert figure["warned slides"] >= 7
        assert figure["first warning, ms"] < 200
    assert list(tmp_path.iterdir()) == []
