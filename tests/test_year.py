"""Some days of the simulated year: each criterion holds, and a broken account is found."""

import asyncio
from pathlib import Path

from simulated_disk import small_disk
from simulated_year import simulate
from year import judge


def test_days_of_a_daemon_balance_whatever_the_clock_and_the_link_do(tmp_path: Path) -> None:
    with small_disk(tmp_path) as disk:
        year = asyncio.run(simulate(2, 3, disk))
    assert ([row for row in judge(year) if not row.good], year.done["daemon restart"]) == ([], 2)
    year.seen.events.popitem()
    year.seen.unbalanced.append("a frame too many")
    assert [row.what.partition(" ")[0] for row in judge(year) if not row.good] == ["frames,", "events"]
