"""Orders that travel with the frames: who sent one hears what became of it, and of no other."""

import asyncio

import pytest

from resonator_daemon.config import Measurement
from resonator_daemon.pipeline.control_requests import ControlRequests, MeasureOver, Tare, parse_control


async def test_each_order_gets_its_own_answer_whatever_comes_between() -> None:
    sent: list[tuple[str, str]] = []
    both = asyncio.Event()

    def send(key: str, order: str) -> None:
        sent.append((key, order))
        if len(sent) == 2:
            both.set()

    requests = ControlRequests(send)
    first = asyncio.create_task(requests.request(Tare()))
    second = asyncio.create_task(requests.request(MeasureOver(measurement=Measurement(window_ms=20, step_ms=10))))
    await both.wait()
    requests.applied("of a recording", "")
    (first_key, tare), (second_key, window) = sent
    requests.applied(second_key, "")
    requests.applied(first_key, "touched")
    assert (await first, await second) == ("touched", "")
    requests.applied(first_key, "again")
    assert parse_control(tare) == Tare()
    assert parse_control(window) == MeasureOver(measurement=Measurement(window_ms=20, step_ms=10))


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", '{"verb": "fly"}', '{"verb": "measure_over", "measurement": {"window_ms": -1}}']
)
def test_what_is_no_order_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="validation error"):
        parse_control(text)
