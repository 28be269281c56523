"""Example and keys in docs/reference/configuration.md: `python docs/tables/configuration_tables.py` writes them."""

import re
from pathlib import Path

from resonator_daemon.board.config import example_config
from resonator_daemon.board.config.help import config_keys

PAGE = Path(__file__).parents[1] / "reference" / "configuration.md"
EXAMPLE = re.compile(r"(from:\n\n```toml\n).*?(```)", re.DOTALL)
KEYS = re.compile(r"(<!-- keys -->\n\n)(?:\|.*\n)*\n*")


def with_tables(page: str) -> str:
    """Return the page with the example and the table as the models have them."""
    page = EXAMPLE.sub(lambda found: f"{found[1]}{example_config()}{found[2]}", page)
    return KEYS.sub(lambda found: f"{found[1]}{_table()}\n", page)


def _table() -> str:
    rows = ["| key | what | type | default | range | |", "| --- | --- | --- | --- | --- | --- |"]
    for key in config_keys():
        cells = (
            f"`{key.path}`",
            key.meaning,
            key.kind,
            f"`{key.default}`" if key.default else "",
            key.limits,
            "live" if key.live else "",
        )
        rows.append("|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|")
    return "\n".join(rows) + "\n"


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text()))
