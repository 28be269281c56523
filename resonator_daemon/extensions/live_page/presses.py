"""Presses of emulated plates: requests to the control sockets of emulators, and the truth that they report."""

import asyncio
import json
import logging
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.extensions.live_page.protocol import RefusedRequest

TRUTH_S: Final = 0.05
AGAIN_S: Final = 1.0  # after an emulator was absent

_ANSWER_S: Final = 5.0
_LINE_BYTES_MAX: Final = 1 << 20

log = logging.getLogger(__name__)


class Board(NamedTuple):
    """What identifies an emulated board: name of its plate, serial number."""

    plate: str
    serial_number: str


class ControlConnection:
    """One connection to a control socket, whose end releases all touches that were pressed over it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._busy = asyncio.Lock()

    async def request(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """Return the emulator's answer.

        Raises
        ------
        OSError
            There is no emulator at the socket, or it does not answer.
        """
        async with self._busy:
            try:
                async with asyncio.timeout(_ANSWER_S):
                    if self._streams is None:
                        self._streams = await asyncio.open_unix_connection(self._path, limit=_LINE_BYTES_MAX)
                    reader, writer = self._streams
                    writer.write(json.dumps(content).encode() + b"\n")
                    await writer.drain()
                    line = await reader.readline()
                    if not line:
                        raise ConnectionResetError("the emulator has ended")
                    answer: dict[str, Any] = json.loads(line)
                    return answer
            except BaseException as error:
                self.close()  # a late answer would be that of the next request
                if isinstance(error, ValueError):
                    raise ConnectionAbortedError(f"{self._path} is no control socket of an emulator") from None
                raise

    def close(self) -> None:
        """Release all touches of this connection."""
        if self._streams is not None:
            self._streams[1].close()
        self._streams = None


class Emulators:
    """The emulators whose plates can be pressed, as long as `run` lasts.

    Parameters
    ----------
    paths
        Of their control sockets.
    on_change
        Called when an emulator was found, or is gone.
    on_truth
        Called with the board and the truth of its newest frame, 20 times a second for boards in `wanted`.
    """

    def __init__(
        self, paths: Collection[Path], on_change: Callable[[], None], on_truth: Callable[[Board, dict[str, Any]], None]
    ) -> None:
        self.boards: dict[Board, Path] = {}
        self.wanted: Collection[Board] = ()
        self._paths = tuple(paths)
        self._on_change = on_change
        self._on_truth = on_truth

    async def run(self) -> None:
        """Look for the emulators, and report the truth of their plates, until cancelled."""
        await asyncio.gather(*map(self._follow, self._paths))

    async def _follow(self, path: Path) -> None:
        problem = ""
        while True:
            connection = ControlConnection(path)
            try:
                answer = await connection.request({"info": True})
                if answer.get("ok") is not True:
                    raise ConnectionAbortedError(str(answer.get("error", {}).get("message")))
                problem = ""
                await self._report_truth(connection, path, Board(str(answer["plate"]), str(answer["serial_number"])))
            except (OSError, KeyError, AttributeError) as error:
                if problem != (problem := meaning_of(error)):
                    log.warning("no emulator at %s: %s; trying again", path, problem)
            finally:
                connection.close()
            await asyncio.sleep(AGAIN_S)

    async def _report_truth(self, connection: ControlConnection, path: Path, board: Board) -> None:
        log.info("emulated %s can be pressed", board.plate)
        self.boards[board] = path
        self._on_change()
        try:
            while True:
                if board in self.wanted:
                    truth = (await connection.request({"truth": True})).get("truth")
                    if isinstance(truth, dict):
                        self._on_truth(board, truth)
                    await asyncio.sleep(TRUTH_S)
                else:
                    await connection.request({"info": True})  # so that its end is noticed
                    await asyncio.sleep(AGAIN_S / 4)
        finally:
            self.boards.pop(board, None)
            self._on_change()


class Touches:
    """Touches of one browser: a connection to each emulator that it presses."""

    def __init__(self) -> None:
        self._connections: dict[Path, ControlConnection] = {}

    async def request(self, path: Path, content: Mapping[str, Any]) -> dict[str, Any]:
        """Send a request to an emulator; return its answer.

        Raises
        ------
        RefusedRequest
            The emulator refused it, or is gone.
        """
        connection = self._connections.setdefault(path, ControlConnection(path))
        try:
            answer = await connection.request(content)
        except (OSError, TimeoutError) as error:
            raise RefusedRequest("no_emulator", f"no emulator at {path}: {meaning_of(error)}") from None
        if answer.get("ok") is not True:
            problem = answer.get("error", {})
            raise RefusedRequest(str(problem.get("code")), str(problem.get("message")))
        return answer

    def release_all(self) -> None:
        for connection in self._connections.values():
            with suppress(OSError):
                connection.close()
        self._connections.clear()
