"""Router between sources and browsers: selects the messages for each browser and executes requests."""

import asyncio
import json
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from aiohttp import WSCloseCode, web

from resonator_daemon.base.errors import UserError
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.extensions.live_page.broker_relay import CONNECTING, BrokerRelay
from resonator_daemon.extensions.live_page.browser import Browser
from resonator_daemon.extensions.live_page.library import Library
from resonator_daemon.extensions.live_page.player import Player, play
from resonator_daemon.extensions.live_page.presses import Board, Emulators
from resonator_daemon.extensions.live_page.protocol import (
    LIVE,
    Command,
    Open,
    Play,
    Press,
    Recordings,
    RefusedRequest,
    Release,
    Request,
    Seek,
    Watch,
    payload_frame,
    payload_of,
    text_frame,
)
from resonator_daemon.mqtt.payloads import Condition
from resonator_daemon.mqtt.requests import request as send_command
from resonator_daemon.mqtt.topics import CONTACT_EVENT, DECODED, INFO, STATE_DAEMON, TOPICS

COMMANDS: Final = ("tare", "mark", "start_recording", "stop_recording")

_REPORT_S: Final = 1.0
_MAP_S: Final = 0.05  # between maps of a plate at least, but for the first after an event


@dataclass(frozen=True)
class Sources:
    """What a page shows.

    Parameters
    ----------
    broker
        Whose plates are shown; None: only recordings are.
    recordings
        At most two, which each browser has open first.
    directory
        Whose recordings browsers may open.
    presses
        Control sockets of emulators.
    allow_commands
        Whether browsers may send commands to the daemons.
    """

    broker: Mqtt | None
    recordings: Sequence[Path] = ()
    directory: Path | None = None
    presses: Sequence[Path] = ()
    allow_commands: bool = False


class Hub:
    """The sources of a page and its browsers, as long as `run` lasts."""

    def __init__(self, sources: Sources) -> None:
        self._sources = sources
        self._browsers: set[Browser] = set()
        self._retained: dict[tuple[str, str], bytes] = {}  # by plate and path: messages to the page
        self._next_map_s: dict[str, float] = {}  # by plate
        self._boards: dict[str, Board] = {}  # by plate: the boards of those that are online, and no replay
        self._status = {"connected": False, "reason_code": CONNECTING, "reason": "", "since_t_ns": str(time.time_ns())}
        broker = sources.broker
        self._relay = None if broker is None else BrokerRelay(broker, self._relay_message, self._set_status)
        self._library = Library(sources.directory, self._send_hello)
        self._emulators = Emulators(sources.presses, self._send_hello, self._send_truth)

    @property
    def browsers(self) -> int:
        """How many are connected."""
        return len(self._browsers)

    async def run(self) -> None:
        """Receive from all sources until cancelled."""
        self._library.exchange((), self._sources.recordings)  # decoded once, and kept
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._report())
                tasks.create_task(self._emulators.run())
                if self._relay is not None:
                    tasks.create_task(self._relay.run())
        finally:
            for browser in self._browsers:
                browser.show((), self._library.exchange(browser.opened, ()))
            await self._library.close()

    async def connect(self, request: web.Request) -> web.StreamResponse:
        """Serve a browser until it disconnects."""
        browser = Browser(self._answer)
        recordings = self._sources.recordings
        browser.show(recordings, self._library.exchange((), recordings))
        browser.outgoing.put(self._hello(browser))
        if self._relay is not None:
            browser.outgoing.put(text_frame("broker", self._status))
        for message in self._retained.values():
            browser.outgoing.put(message)
        self._browsers.add(browser)
        playing = asyncio.create_task(play(lambda: browser.players.values()))
        try:
            return await browser.run(request)
        finally:
            self._browsers.discard(browser)
            browser.touches.release_all()
            playing.cancel()
            self._library.exchange(browser.opened, ())
            self._update_watched()

    async def disconnect_all(self) -> None:
        """End the connections to all browsers."""
        for browser in list(self._browsers):
            await browser.close(WSCloseCode.GOING_AWAY, "stopping")

    def _hello(self, browser: Browser) -> str:
        sources: list[dict[str, Any]] = []
        if self._sources.broker is not None:
            sources.append({"source": LIVE, "url": self._sources.broker.anonymous().url})
        for source, player in browser.players.items():
            sources.append({"source": source, "opening": browser.openings} | player.recorded.describe())
        hello = {
            "version": version("resonatord"),
            "sources": sources,
            "directory": self._library.name,
            "commands": COMMANDS if self._sources.allow_commands and self._relay else (),
            "press": [plate for plate, board in self._boards.items() if board in self._emulators.boards],
        }
        return text_frame("hello", hello)

    def _send_hello(self) -> None:
        for browser in self._browsers:
            browser.outgoing.put(self._hello(browser))

    def _send_to_all(self, message: str | bytes) -> None:
        for browser in self._browsers:
            browser.outgoing.put(message)

    def _relay_message(self, plate: str, path: str, payload: bytes) -> None:
        message = payload_frame(LIVE, plate, path, payload)
        if message is None:
            return
        if path == CONTACT_EVENT.path:
            self._next_map_s.pop(plate, None)
        if not TOPICS[path].qos:
            if path == DECODED.path:
                now_s, next_s = time.monotonic(), self._next_map_s.get(plate, 0.0)
                if now_s < next_s:
                    return
                self._next_map_s[plate] = max(next_s, now_s - _MAP_S) + _MAP_S
            stream = f"{LIVE}/{plate}/{path}"
            for browser in self._browsers:
                if browser.watches(LIVE, plate, path):
                    browser.outgoing.put_newest(stream, message)
            return
        if TOPICS[path].retained:
            self._retained.pop((plate, path), None)
            if payload:
                self._retained[plate, path] = message
        self._send_to_all(message)
        if path in (INFO.path, STATE_DAEMON.path) and self._sources.presses:
            self._find_boards()

    def _find_boards(self) -> None:
        """Find which board each plate measures now, so that presses of it go to its emulator."""
        boards = {}
        for plate in {plate for plate, _ in self._retained}:
            with suppress(ValueError, RecursionError, KeyError, TypeError):
                info, state = (
                    json.loads(payload_of(self._retained[plate, topic.path])) for topic in (INFO, STATE_DAEMON)
                )
                if state["state"] == Condition.ONLINE and state["reason_code"] != ReasonCode.REPLAYING:
                    boards[plate] = Board(str(info["plate"]), str(info["serial_number"]))
        if boards != self._boards:
            self._boards = boards
            self._send_hello()
            self._update_watched()

    def _set_status(self, status: dict[str, Any]) -> None:
        is_same = status["connected"] == self._status["connected"]
        since_t_ns = self._status["since_t_ns"] if is_same else str(time.time_ns())
        if (status := status | {"since_t_ns": since_t_ns}) != self._status:
            self._status = status
            self._send_to_all(text_frame("broker", status))

    def _send_truth(self, board: Board, truth: dict[str, Any]) -> None:
        for plate in [plate for plate, its_board in self._boards.items() if its_board == board]:
            t_ns, contacts = truth["gate_middle_t_ns"], truth["contacts"]  # as messages of measured values
            message = text_frame("truth", {"plate": plate, "t_ns": t_ns, "contacts": contacts, "traction_pascal": None})
            for browser in self._browsers:
                if (watched := browser.watched.get(LIVE)) is not None and watched[0] == plate:
                    browser.outgoing.put_newest("truth", message)

    async def _report(self) -> None:
        while True:
            await asyncio.sleep(_REPORT_S)
            for browser in self._browsers:
                content = {"count": len(self._browsers), "skipped": browser.outgoing.skipped}
                browser.outgoing.put_newest("clients", text_frame("clients", content))

    async def _answer(self, browser: Browser, request: Request) -> dict[str, Any]:
        match request.content:
            case Watch() as watch:
                self._watch(browser, watch)
            case Command() as command:
                return await self._command(command)
            case Press() | Release() as press:
                return await self._press(browser, press)
            case Play() as play:
                self._player(browser, play.source).play(play.playing, play.speed)
            case Seek() as seek:
                self._player(browser, seek.source).seek(seek.t_s)
            case Recordings():
                return await self._library.listing()
            case Open() as wanted:
                await self._open(browser, wanted.names)
        return {}

    async def _open(self, browser: Browser, names: Sequence[str]) -> None:
        found = await self._library.find(names)
        browser.show(found, self._library.exchange(browser.opened, found))
        browser.outgoing.put(self._hello(browser))

    def _player(self, browser: Browser, source: str) -> Player:
        if source not in browser.players:
            raise RefusedRequest("unknown_source", f"source: {source!r} is no recording of this page")
        return browser.players[source]

    def _watch(self, browser: Browser, watch: Watch) -> None:
        if watch.source != LIVE:
            player = self._player(browser, watch.source)
        elif self._relay is None:
            raise RefusedRequest("unknown_source", "source: this page shows recordings, and no broker's plates")
        if any(sign in watch.plate for sign in "/+#\0"):
            raise RefusedRequest("unknown_plate", f"plate: {watch.plate!r} is no name of a plate")
        browser.outgoing.clear_streams(f"{watch.source}/")
        browser.watched[watch.source] = (watch.plate, watch.topics)
        if watch.source != LIVE:
            player.watch()
        self._update_watched()

    def _update_watched(self) -> None:
        watched = [browser.watched[LIVE] for browser in self._browsers if LIVE in browser.watched]
        self._emulators.wanted = {self._boards[plate] for plate, _ in watched if plate in self._boards}
        if self._relay is not None:
            self._relay.watch({(plate, path) for plate, paths in watched for path in paths})

    async def _command(self, command: Command) -> dict[str, Any]:
        if not self._sources.allow_commands or self._sources.broker is None:
            raise RefusedRequest("read_only", "this page sends no commands; `resonatord view --allow-commands` does")
        if command.verb not in COMMANDS:
            raise RefusedRequest("unknown_verb", f"verb: {command.verb!r}; must be one of {', '.join(COMMANDS)}")
        if not any(plate == command.plate for plate, _ in self._retained):
            raise RefusedRequest("unknown_plate", f"plate: {command.plate!r} publishes nothing")
        try:
            answer = await send_command(self._sources.broker, command.plate, command.verb, command.arguments)
        except UserError as error:
            raise RefusedRequest(error.code, str(error)) from None
        return {key: value for key, value in answer.items() if key != "id"}

    async def _press(self, browser: Browser, press: Press | Release) -> dict[str, Any]:
        board = self._boards.get(press.plate)
        path = None if board is None else self._emulators.boards.get(board)
        if path is None:
            raise RefusedRequest("not_pressable", f"plate: {press.plate!r} is no emulated plate; see --press")
        key = "press" if isinstance(press, Press) else "release"
        return await browser.touches.request(path, {key: press.name, **(press.model_extra or {})})
