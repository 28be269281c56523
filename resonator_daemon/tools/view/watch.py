"""`resonatord watch`: follow what plates publish, as a live page, as lines of text, or as JSON."""

import asyncio
import json
import logging
import sys
import time
from collections.abc import AsyncGenerator, Callable, Iterator, Sequence
from contextlib import aclosing, contextmanager
from typing import Final

from rich.console import Console
from rich.live import Live
from rich.text import Text

from resonator_daemon.base.host.signals import on_signals
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.payloads import Message
from resonator_daemon.mqtt.subscriber import EVERY_PLATE, Received, subscribe
from resonator_daemon.tools.view.plate_view import PlateView
from resonator_daemon.tools.view.terminal import render, summary_line

_PAGE_S: Final = 1 / 8
_LINES_S: Final = 1.0

Draw = Callable[[Sequence[PlateView]], None]
Messages = AsyncGenerator[Received]


async def watch(broker: Mqtt, plate: str | None, *, as_json: bool) -> None:
    """Show what one plate publishes, None: every plate, until SIGINT, SIGTERM, SIGHUP, or the reader of a pipe leaves.

    Streams come as often as people can follow, by their decimated topics.
    """
    console, messages = Console(), subscribe(broker, plate=plate or EVERY_PLATE, full_rate=False)
    waiting = _waiting(broker, plate)
    if as_json:
        showing = asyncio.create_task(_print_messages(messages))
    elif sys.stdout.isatty() and not console.is_dumb_terminal:
        showing = asyncio.create_task(_show_page(broker, messages, console, waiting))
    else:
        showing = asyncio.create_task(_redraw(messages, _print_lines(waiting), _LINES_S))
    try:
        with on_signals(showing.cancel):
            await asyncio.wait([showing])
        if not showing.cancelled():
            showing.result()
    finally:
        showing.cancel()


def json_line(plate: str, path: str, message: Message) -> str:
    """Return a message as one line of JSON: arrays as nested lists, numbers that are not known as null."""
    payload = message.model_dump_json(fallback=lambda array: array.tolist())
    return f'{{"plate": {json.dumps(plate)}, "topic": {json.dumps(path)}, "message": {payload}}}\n'


async def _print_messages(received: Messages) -> None:
    async with aclosing(received) as messages:
        async for plate, path, message in messages:
            sys.stdout.write(json_line(plate, path, message))
            sys.stdout.flush()


async def _show_page(broker: Mqtt, received: Messages, console: Console, waiting: str) -> None:
    first_notice = f"waiting for a broker at {broker.host}:{broker.port}"
    with _last_log_line(first_notice) as notice, Live(console=console, screen=True, auto_refresh=False) as live:

        def draw(views: Sequence[PlateView]) -> None:
            title = f"resonatord watch · {notice()}"
            page = render(views, {}, time.time_ns(), title=title) if views else Text(f"{title}\n{waiting}")
            live.update(page, refresh=True)

        await _redraw(received, draw, _PAGE_S)


def _print_lines(waiting: str) -> Draw:
    printed = ""

    def draw(views: Sequence[PlateView]) -> None:
        nonlocal printed
        text = "\n".join(summary_line(view, time.time_ns()) for view in views) or waiting
        if views or text != printed:
            sys.stdout.write(text + "\n")
            sys.stdout.flush()
        printed = text

    return draw


async def _redraw(received: Messages, draw: Draw, period_s: float) -> None:
    views: dict[str, PlateView] = {}
    listening = asyncio.create_task(_listen(received, views))
    try:
        while not listening.done():
            draw(list(views.values()))
            await asyncio.wait([listening], timeout=period_s)
        listening.result()
    finally:
        listening.cancel()
        await asyncio.wait([listening])


async def _listen(received: Messages, views: dict[str, PlateView]) -> None:
    async with aclosing(received) as messages:
        async for plate, path, message in messages:
            views.setdefault(plate, PlateView(plate)).add(path, message, time.time_ns())


def _waiting(broker: Mqtt, plate: str | None) -> str:
    who, where = plate or "a plate", f"{broker.prefix}/{plate or '#'}"
    return f"waiting for {who} to publish below {where} at {broker.host}:{broker.port}"


@contextmanager
def _last_log_line(first: str) -> Iterator[Callable[[], str]]:
    """Keep the log off the page that it would spoil; yields a function that returns its last line."""
    lines = [first]

    class LastLine(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            lines[:] = [record.getMessage()]

    root = logging.getLogger()
    handlers = root.handlers
    root.handlers = [LastLine()]
    try:
        yield lambda: lines[0]
    finally:
        root.handlers = handlers
