"""Supervisor of a decoder process: sends it one frame at a time, delivers its messages, restarts it."""

import asyncio
import contextlib
import logging
import os
import signal
import sys
import time
from asyncio.subprocess import DEVNULL, Process
from collections import Counter
from dataclasses import replace
from typing import Final, Literal

import psutil

from resonator_daemon.base.errors import reason_of
from resonator_daemon.base.host.load import ProcessUsage
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.measure.decoder_process.decoder_connection import DecoderConnection
from resonator_daemon.measure.sensors.surface_decoding import Origin, SurfaceClient, SurfaceDecoding
from resonator_daemon.measure.sensors.surface_requests import Reply, Request, Results, SurfaceSettings
from resonator_daemon.mqtt.pacing import Backoff
from resonator_daemon.mqtt.payloads import DecoderProcessInfo

HUNG_S: Final = 5.0  # without a reply about a frame, which takes some ms
SET_UP_MAX_S: Final = 600.0  # of a start, or of one step of a set-up
RESTART_FIRST_S: Final = 0.5
RESTART_LONGEST_S: Final = 30.0
SOUND_S: Final = 60.0  # of running, after which the back-off starts from the beginning
_EXIT_S: Final = 1.0  # of a process that has closed its socket

Ending = Literal["crashed", "hung"]
_ENDINGS: Final[dict[Ending, ReasonCode]] = {"crashed": ReasonCode.DECODER_CRASHED, "hung": ReasonCode.DECODER_HUNG}

# More threads of linear algebra cost more in waiting than they save on arrays of this size.
_ONE_THREAD: Final = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

log = logging.getLogger(__name__)


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
        self._connection: DecoderConnection | None = None
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
                log.error("decoder of %s %s (%s): it is restarted in %.1f s", self._name, ending, how, pause_s)
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
        self._connection, (other, memory_fd) = DecoderConnection.pair(self._settings)
        asyncio.get_running_loop().add_reader(self._connection.socket, self._read, self._connection)
        with other:
            try:
                process = await asyncio.create_subprocess_exec(
                    *(sys.executable, "-P", "-m", __package__, self._name, str(other.fileno()), str(memory_fd)),
                    stdin=DEVNULL,
                    stdout=DEVNULL,
                    pass_fds=(other.fileno(), memory_fd),
                    env=os.environ | _ONE_THREAD,
                )
            finally:
                os.close(memory_fd)
        with contextlib.suppress(psutil.Error):  # it has ended already
            self._usage = ProcessUsage(process.pid)
        self._send(replace(self._settings, last_contact_id=self.last_contact_id), SET_UP_MAX_S)
        return process

    def _disconnect(self) -> None:
        if self._connection is not None:
            asyncio.get_running_loop().remove_reader(self._connection.socket)
            self._connection.socket.close()
        if self._deadline is not None:
            self._deadline.cancel()
        self._skip_present("decoder_ended")
        self._connection = self._ending = self._usage = self._interruption = None
        self._is_idle = False
        self._ready_ns, self._until_ready = None, "decoder_ended"

    def _wake(self) -> None:
        if self._is_idle and (request := self._next_request()) is not None:
            self._is_idle = False
            self._send(request, HUNG_S)

    def _send(self, request: SurfaceSettings | Request, within_s: float) -> None:
        """Write a request without waiting; a reply has to come within a time."""
        if self._connection is not None:
            try:
                self._connection.send(request)
            except OSError:
                self._end("crashed")
            else:
                self._expect_reply(within_s)

    def _read(self, connection: DecoderConnection) -> None:
        """Handle a reply that has arrived."""
        try:
            reply: Reply = connection.receive()
        except (EOFError, ConnectionError):
            asyncio.get_running_loop().remove_reader(connection.socket)
            self._end("crashed")
        else:
            self._received(reply)

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
