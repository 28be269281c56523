"""The daemon survives a cable that is pulled again and again; a thousand times in `make soak`."""

from pathlib import Path

from hang_ups import hang_up


def test_it_always_comes_back_and_leaks_nothing(tmp_path: Path) -> None:
    result = hang_up(3, tmp_path, seed=1)
    assert result.wrong == []
    assert result.lasting >= 2
    assert result.outages >= result.lasting
