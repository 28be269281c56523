"""Supervisor of a decoder process: sends it one frame at a time, delivers its messages, restarts it."""

import asyncio
import contextlib
import logging
import os
import pickle
import signal
import socket
import sys
import time
from asyncio.subprocess import DEVNULL, Process
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Final, Literal

import psutil

from resonator_daemon.base.errors import reason_of
from resonator_daemon.base.host.load import ProcessUsage
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.measure.decoder_process.worker import LENGTH, packed
from resonator_daemon.measure.sensors.surface_decoding import Origin, SurfaceClient, SurfaceDecoding
from resonator_daemon.measure.sensors.surface_worker import Reply, Request, Results, SurfaceSettings
from resonator_daemon.mqtt.pacing import Backoff
from resonator_daemon.mqtt.payloads import DecoderProcessInfo

HUNG_S: Final = 5.0  # without a reply about a frame, which takes some ms
SET_UP_MAX_S: Final = 600.0  # of a start, or of one step of a set-up
RESTART_FIRST_S: Final = 0.5
RESTART_LONGEST_S: Final = 30.0
SOUND_S: Final = 60.0  # of running, after which the back-off starts from the beginning
_EXIT_S: Final = 1.0  # of a process that has closed its socket

Ending = Literal["crashed", "hung"]
_ENDINGS: Final[dict[Ending, ReasonCode]] = {
    "crashed": ReasonCode.DECODER_CRASHED,
    "hung": ReasonCode.DECODER_HUNG,
}

# More threads of linear algebra cost more in waiting than they save on arrays of this size.
_ONE_THREAD: Final = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

log = logging.getLogger(__name__)


class WorkerConnection(asyncio.Protocol):
    """The daemon's end of the socket to a decoder process: writes requests without waiting, and reads replies.

    Parameters
    ----------
    on_reply
        Called with each reply.
    on_lost
        Called when the other end is closed.
    """

    def __init__(self, on_reply: Callable[[Reply], None], on_lost: Callable[[], None]) -> None:
        self._on_reply = on_reply
        self._on_lost = on_lost
        self._transport: asyncio.Transport | None = None
        self._received = bytearray()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        if isinstance(transport, asyncio.Transport):
            self._transport = transport

    def send(self, request: SurfaceSettings | Request) -> None:
        """Write a request; ignored after `close`."""
        if self._transport is not None:
            self._transport.write(packed(request))

    def close(self) -> None:
        """Close the connection at once; neither `on_reply` nor `on_lost` is called any more."""
        if self._transport is not None:
            self._transport.abort()
            self._transport = None

    def data_received(self, data: bytes) -> None:
        self._received += data
        while self._transport is not None and len(self._received) >= LENGTH.size:
            (length,) = LENGTH.unpack_from(self._received)
            end = LENGTH.size + length
            if len(self._received) < end:
                return
            with memoryview(self._received) as view:
                reply: Reply = pickle.loads(view[LENGTH.size : end])
            del self._received[:end]
            self._on_reply(reply)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._transport is not None:
            self._transport = None
            self._on_lost()


class DecoderSupervisor(SurfaceDecoding[Origin]):
    """Decoding by a child process; to be used from the event loop's thread only.

    Parameters
    ----------
    settings
        Sent to each process that is started.
    client
        Receives the messages.
    name
        Name of the plate, an argument of the process and in its log.

    Attributes
    ----------
    restarts
        Number of restarts, by what ended the process before.
    """

    def __init__(self, settings: SurfaceSettings, client: SurfaceClient[Origin], name: str = "skin") -> None:
        super().__init__(settings, client, name)
        self._connection: WorkerConnection | None = None
        self._usage: ProcessUsage | None = None
        self._is_idle = False
        self._ending: asyncio.Future[Ending | None] | None = None
        self._deadline: asyncio.TimerHandle | None = None
        self.restarts: Counter[Ending] = Counter()

    def info(self) -> DecoderProcessInfo:
        """Return the counters of frames and restarts, and what the process uses."""
        use = self._usage.measure() if self._usage is not None else None
        return DecoderProcessInfo(
            pid=self._usage.pid if self._usage is not None else None,
            restarts=dict(self.restarts),
            decoded=self.decoded,
            skipped=dict(self.skipped),
            waiting=self.waiting,
            cpu_percent=use.cpu_percent if use is not None else 0.0,
            rss_mb=use.rss_mb if use is not None else 0.0,
        )

    def interrupt(self, reason: Reason) -> None:
        """Release all contacts, because frames have stopped arriving; at once where there is no process."""
        if self._connection is None:
            self.release_contacts(reason)
        else:
            super().interrupt(reason)

    async def run(self) -> None:
        """Keep a process running until cancelled, or until it turns out that the sites cannot be decoded."""
        backoff = Backoff(RESTART_FIRST_S)
        try:
            while True:
                started_s = time.monotonic()
                ending, how = await self._run_process()
                if ending is None:
                    return
                self.release_contacts(Reason(_ENDINGS[ending], f"the decoder {ending}"))
                if time.monotonic() - started_s > SOUND_S:
                    backoff.reset()
                pause_s = backoff.next_s(RESTART_LONGEST_S)
                log.error("decoder %s (%s): it is restarted in %.1f s", ending, how, pause_s)
                self._client.announce(Reason(_ENDINGS[ending], f"decoder {ending} ({how}) and is restarted"))
                await asyncio.sleep(pause_s)
                self.restarts[ending] += 1
        finally:
            self._skip_all()

    async def _run_process(self) -> tuple[Ending | None, str]:
        """Run a process to its end; return what ended it, None if it cannot decode the sites, and details."""
        ending = self._ending = asyncio.get_running_loop().create_future()
        process: Process | None = None
        try:
            process = await self._start()
            how = await ending
            if how != "hung":  # it ends by itself; killed meanwhile, it would be reaped without its exit code
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(_EXIT_S):
                        await process.wait()
        except OSError as error:
            return "crashed", reason_of(error)
        finally:
            self._disconnect()
            if process is not None and process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    process.kill()  # it has nothing to save
                await process.wait()
        return how, f"no result for {HUNG_S:g} s" if how == "hung" else _in_words(process.returncode)

    async def _start(self) -> Process:
        own, other = socket.socketpair()
        connection = WorkerConnection(self._received, lambda: self._end("crashed"))
        with other:
            try:
                await asyncio.get_running_loop().create_unix_connection(lambda: connection, sock=own)
            except BaseException:
                own.close()
                raise
            self._connection = connection
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-P", "-m", __package__, self._name, str(other.fileno())),
                stdin=DEVNULL,
                stdout=DEVNULL,
                pass_fds=(other.fileno(),),
                env=os.environ | _ONE_THREAD,
            )
        with contextlib.suppress(psutil.Error):  # it has ended already
            self._usage = ProcessUsage(process.pid)
        connection.send(replace(self._settings, last_contact_id=self.last_contact_id))
        self._expect_reply(SET_UP_MAX_S)
        return process

    def _disconnect(self) -> None:
        if self._connection is not None:
            self._connection.close()
        if self._deadline is not None:
            self._deadline.cancel()
        self._skip_present("decoder_ended")
        self._connection = self._ending = self._usage = self._interruption = None
        self._is_idle = False
        self._ready_ns, self._until_ready = None, "decoder_ended"

    def _wake(self) -> None:
        if self._connection is not None and self._is_idle and (request := self._next_request()) is not None:
            self._is_idle = False
            self._connection.send(request)
            self._expect_reply(HUNG_S)

    def _received(self, reply: Reply) -> None:
        super()._received(reply)
        if self._undecodable:
            self._end(None)
        elif not isinstance(reply, Results):
            self._expect_reply(HUNG_S if self._ready_ns is not None else SET_UP_MAX_S)
        elif reply.outcome is not None:
            self._is_idle = True
            if self._deadline is not None:
                self._deadline.cancel()
            self._wake()

    def _expect_reply(self, within_s: float) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = asyncio.get_running_loop().call_later(within_s, self._end, "hung")

    def _end(self, ending: Ending | None) -> None:
        if self._ending is not None and not self._ending.done():
            self._ending.set_result(ending)


def _in_words(exit_code: int | None) -> str:
    if exit_code is not None and exit_code < 0:
        return f"by {signal.Signals(-exit_code).name}"
    return f"exit code {exit_code}"
