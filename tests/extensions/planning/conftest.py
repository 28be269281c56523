"""Figures of matplotlib as they are saved."""

import pytest
from matplotlib.figure import Figure


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Every figure as it is saved."""
    saved: list[Figure] = []
    save = Figure.savefig

    def remember(figure: Figure, *arguments: object) -> None:
        saved.append(figure)
        save(figure, *arguments)

    monkeypatch.setattr(Figure, "savefig", remember)
    return saved
