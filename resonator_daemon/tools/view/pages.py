"""Parts of pages in tables and pictures: tables of numbers, and empty figures."""

from typing import TYPE_CHECKING

from rich.table import Table

from resonator_daemon.base.errors import MissingLibraryError
from resonator_daemon.base.host.text import how_to_install

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def number_table(first: str, *others: str) -> Table:
    """Return a table without lines, numbers at the right of each column but the first."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(first, overflow="fold")
    for name in others:
        table.add_column(name, justify="right", overflow="fold")
    return table


def make_figure(inches: tuple[float, float]) -> "Figure":
    """Return an empty figure, which `savefig` writes in the format of a file's suffix; UserError without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise MissingLibraryError(
            f"--picture needs {error.name}, which is not installed: {how_to_install('matplotlib')}"
        ) from error
    return Figure(figsize=inches, layout="constrained")
