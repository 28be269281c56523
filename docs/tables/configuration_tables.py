"""Example and keys in docs/reference/configuration.md: `python docs/tables/configuration_tables.py` writes them."""

import re
from pathlib import Path

from resonator_daemon.board.config import example_config
from resonator_daemon.board.config.help import config_keys

PAGE = Path(__file__).parents[1] / "reference" / "configuration.md"
EXAMPLE = re.compile(r"(from:\n\n```toml\n).*?(```)", re.DOTALL)
KEYS = re.compile(r"(<!-- keys -->\n\n)(?:[-|] .*\n)*\n*")


def with_tables(page: str) -> str:
    """Return the page with the example and the list as the models have them."""
    page = EXAMPLE.sub(lambda found: f"{found[1]}{example_config()}{found[2]}", page)
    return KEYS.sub(lambda found: f"{found[1]}{_list()}\n", page)


def _list() -> str:
    lines = []
    for key in config_keys():
        facts = (key.kind, f"default `{key.default}`" if key.default else "", key.limits, "live" if key.live else "")
        lines.append(f"- `{key.path}` ({'; '.join(filter(None, facts))}): {key.meaning}\n")
    return "".join(lines)


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text()))
