"""Control requests that travel with the frames: each sender gets the answer to its own."""

import asyncio

import pytest

from resonator_daemon.board.config.tables import Measurement
from resonator_daemon.measure.pipeline.control_requests import ControlRequests, SetWindow, Tare, parse_request


async def test_each_request_gets_its_own_answer_whatever_comes_between() -> None:
    sent: list[tuple[str, str]] = []
    both = asyncio.Event()

    def send(key: str, request: str) -> None:
        sent.append((key, request))
        if len(sent) == 2:
            both.set()

    requests = ControlRequests(send)
    first = asyncio.create_task(requests.apply(Tare()))
    second = asyncio.create_task(requests.apply(SetWindow(measurement=Measurement(window_ms=20, step_ms=10))))
    await both.wait()
    requests.applied("of a recording", None)
    (first_key, tare), (second_key, window) = sent
    requests.applied(second_key, None)
    requests.applied(first_key, "touched")
    assert (await first, await second) == ("touched", None)
    requests.applied(first_key, "again")
    assert parse_request(tare) == Tare()
    assert parse_request(window) == SetWindow(measurement=Measurement(window_ms=20, step_ms=10))


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", '{"verb": "fly"}', '{"verb": "measure_over", "measurement": {"window_ms": -1}}']
)
def test_what_is_no_request_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="validation error"):
        parse_request(text)
