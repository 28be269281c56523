"""Hostile commands, some of the million that `make fuzz` tries."""

from pathlib import Path

from command_fuzz import fuzz

from resonator_daemon.publishing.verbs import VERBS

READ_ONLY = {verb.name for verb in VERBS.values() if not verb.changes}
REFUSALS = {"payload", "response_topic", "unknown_verb", "not_permitted", "too_many", "correlation", "unknown_boot"}


async def test_where_nothing_is_allowed_nothing_is_changed(tmp_path: Path) -> None:
    seen = await fuzz(20_000, 2, (), tmp_path)
    assert seen.keys() == READ_ONLY | REFUSALS
    assert min(seen.values()) > 10
    assert list(tmp_path.iterdir()) == []


async def test_where_everything_is_allowed_nothing_escapes(tmp_path: Path) -> None:
    seen = await fuzz(2_000, 3, tuple(VERBS), tmp_path)
    assert seen.keys() >= set(VERBS) | (REFUSALS - {"not_permitted"}) | {"recording", "not_recording", "window"}
    assert list(tmp_path.iterdir()) == []  # the stand-in makes no files, and nothing else does
