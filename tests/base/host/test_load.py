"""Load of a computer from given counters of Linux."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from resonator_daemon.base.host import load
from resonator_daemon.base.host.load import NO_LOAD, LoadMeter, LoadSample

_COUNTED = "some avg10=1.50 avg60=0.00 avg300=0.00 total={}\nfull avg10=0.00 avg60=0.00 avg300=0.00 total=0\n"


@pytest.mark.parametrize(
    ("threads", "pressure", "expected", "later"),
    [
        (True, True, LoadSample(75, 90), LoadSample(75, 80)),
        (True, False, LoadSample(75, 75), LoadSample(0, 0)),
        (False, True, LoadSample(90, 90), LoadSample(80, 80)),
        (False, False, NO_LOAD, NO_LOAD),
    ],
)
def test_the_load_is_measured_from_counters_of_linux(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    threads: bool,
    pressure: bool,
    expected: LoadSample,
    later: LoadSample,
) -> None:
    now_ns = 10**12
    monkeypatch.setattr(load, "time", SimpleNamespace(monotonic_ns=lambda: now_ns))

    def count(used_ms: int, waited_ms: int, pressure_ms: int) -> None:
        for thread in ("7", "8"):
            if threads:
                (tmp_path / "self/task" / thread).mkdir(parents=True, exist_ok=True)
                (tmp_path / "self/task" / thread / "schedstat").write_text(f"{used_ms}000000 {waited_ms}000000 5\n")
        if pressure:
            (tmp_path / "pressure").mkdir(exist_ok=True)
            (tmp_path / "pressure/cpu").write_text(_COUNTED.format(f"{pressure_ms}000"))

    count(500, 400, 300)
    meter = LoadMeter(tmp_path)
    count(510, 430, 525)
    assert meter.sample() == NO_LOAD
    now_ns += 250_000_000
    assert meter.sample() == expected
    now_ns += 40_000_000
    count(510, 430, 565)
    assert meter.sample() == expected  # too soon for another one
    now_ns += 20_000_000
    count(520, 430, 573)  # of a board's silence of 60 ms, the computer was busy for 48
    assert meter.sample() == later
