"""A plain MQTT subscriber that shares no code with the daemon, and keeps what it hears."""

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from contextlib import asynccontextmanager, suppress
from typing import Any
from unittest.mock import patch

import aiomqtt
import pytest
from brokers import client_of

DEADLINE_S = 30.0  # far beyond what any wait takes: it ends a test that hangs


async def until(predicate: Callable[[], bool]) -> None:
    """Look again with each turn of the event loop, for 20 s at most."""
    async with asyncio.timeout(20):
        while not predicate():  # noqa: ASYNC110  there is no event for every condition
            await asyncio.sleep(0.005)


async def logged_once(caplog: pytest.LogCaptureFixture, pause_s: float) -> str:
    """Wait for five attempts, each with a timer of this pause; return the only line of log."""
    loop = asyncio.get_running_loop()
    with patch.object(loop, "call_later", wraps=loop.call_later) as timers:
        await until(lambda: [timer.args[0] for timer in timers.call_args_list].count(pause_s) >= 5)
    (line,) = caplog.messages
    return line


def skipping(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], Awaitable[None]]:
    """Return what lets time of the event loop pass at once, and the timers of that time run."""
    loop = asyncio.get_running_loop()
    now_s = loop.time()
    monkeypatch.setattr(loop, "time", lambda: now_s)

    async def skip(seconds: float) -> None:
        nonlocal now_s
        now_s += seconds
        for _ in range(3):
            await asyncio.sleep(0)

    return skip


@asynccontextmanager
async def running_task(work: Coroutine[Any, Any, None]) -> AsyncIterator["asyncio.Task[None]"]:
    """Run it as a task that is cancelled, and has ended, at the end of the context."""
    task = asyncio.create_task(work)
    try:
        yield task
    finally:
        task.cancel()
        await asyncio.wait([task])


class Observer:
    """Messages in the order of their arrival."""

    def __init__(self, client: aiomqtt.Client) -> None:
        self.client = client
        self.messages: list[aiomqtt.Message] = []
        self._raw: dict[str, list[bytes]] = {}
        self._parsed: dict[str, list[Any]] = {}
        self._news = asyncio.Condition()

    async def listen(self, client: aiomqtt.Client) -> None:
        async for message in client.messages:
            async with self._news:
                self.messages.append(message)
                self._raw.setdefault(message.topic.value, []).append(bytes(message.payload))
                self._news.notify_all()

    def payloads(self, topic: str) -> list[Any]:
        """Return the JSON payloads of a topic so far; each is read once, since this is asked again and again."""
        parsed = self._parsed.setdefault(topic, [])
        parsed += [json.loads(payload) for payload in self.raw(topic)[len(parsed) :]]
        return list(parsed)

    def raw(self, topic: str) -> list[bytes]:
        return self._raw.get(topic, [])

    async def until(self, predicate: Callable[[], bool]) -> None:
        async with asyncio.timeout(DEADLINE_S), self._news:
            await self._news.wait_for(predicate)

    async def until_last(self, topic: str, **expected: object) -> Any:
        """Wait until the last payload of a topic has these fields; return it."""

        def said() -> bool:
            payloads = self.payloads(topic)
            return bool(payloads) and payloads[-1].items() >= expected.items()

        await self.until(said)
        return self.payloads(topic)[-1]

    async def until_count(self, topic: str, count: int) -> list[bytes]:
        """Wait for so many messages of a topic."""
        await self.until(lambda: len(self.raw(topic)) >= count)
        return self.raw(topic)


@asynccontextmanager
async def observe(url: str, topics: str = "#") -> AsyncIterator[Observer]:
    async with client_of(url) as client:
        observer = Observer(client)
        await client.subscribe(topics, qos=1)
        listening = asyncio.create_task(observer.listen(client))
        try:
            yield observer
        finally:
            listening.cancel()
            with suppress(asyncio.CancelledError, aiomqtt.MqttError):
                await listening
