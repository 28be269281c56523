"""Arrivals reach the handler in order, in parts that leave the event loop to others, and none is forgotten."""

import asyncio
from contextlib import nullcontext
from logging import INFO

import pytest

from resonator_daemon.board.session.frames import Arrival, BoardLogLine
from resonator_daemon.daemon.service.arrival_loop import PART_ARRIVALS, ArrivalLoop


def lines(first: int, count: int) -> list[Arrival]:
    return [BoardLogLine(INFO, str(number)) for number in range(first, first + count)]


class Bench:
    """A reader's batches, and the numbers that were handled."""

    def __init__(self, *batches: list[Arrival]) -> None:
        self.batches = list(batches)
        self.handled: list[int] = []
        self.pops = 0
        self.over: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.loop = ArrivalLoop(self.pop, self.handle, nullcontext, self.over)

    def pop(self) -> list[Arrival]:
        self.pops += 1
        return self.batches.pop(0) if self.batches else []

    def handle(self, arrival: object) -> None:
        assert isinstance(arrival, BoardLogLine)
        self.handled.append(int(arrival.text))

    async def until(self, count: int) -> None:
        async with asyncio.timeout(10):
            while len(self.handled) < count:  # noqa: ASYNC110  each turn of the loop is looked at
                await asyncio.sleep(0)


async def test_others_have_their_turn_between_parts() -> None:
    bench = Bench(lines(0, 3 * PART_ARRIVALS + 1))
    bench.loop.wake()
    steps = []
    while len(bench.handled) <= 3 * PART_ARRIVALS:
        await asyncio.sleep(0)
        steps.append(len(bench.handled))
    assert {PART_ARRIVALS, 2 * PART_ARRIVALS, 3 * PART_ARRIVALS} <= set(steps)
    assert bench.handled == list(range(3 * PART_ARRIVALS + 1))


async def test_what_arrives_while_others_are_handled_needs_no_later_arrival() -> None:
    bench = Bench(lines(0, PART_ARRIVALS + 10))
    bench.loop.wake()
    await bench.until(1)  # of two parts
    bench.batches.append(lines(PART_ARRIVALS + 10, 1))
    bench.loop.wake()
    await bench.until(PART_ARRIVALS + 11)
    assert bench.handled == list(range(PART_ARRIVALS + 11))


async def test_it_is_woken_from_another_thread_and_idle_afterwards() -> None:
    bench = Bench(lines(0, 2))
    await asyncio.to_thread(bench.loop.wake)
    await bench.until(2)
    for _ in range(10):
        await asyncio.sleep(0)
    assert bench.pops == 1


async def test_what_the_handler_raises_ends_the_service() -> None:
    bench = Bench(lines(0, 1))
    bench.handle = lambda _: 1 / 0  # type: ignore[method-assign, assignment, return-value]
    bench.loop = ArrivalLoop(bench.pop, bench.handle, nullcontext, bench.over)
    bench.loop.wake()
    with pytest.raises(ZeroDivisionError):
        await bench.over


async def test_nothing_is_handled_when_the_service_is_over() -> None:
    bench = Bench(lines(0, 1), lines(1, 1))
    bench.over.set_result(None)
    bench.loop.wake()
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert bench.handled == []
