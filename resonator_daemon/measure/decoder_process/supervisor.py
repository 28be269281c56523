"""Supervisor of a decoder process: sends it one frame at a time, delivers its messages, restarts it."""

import asyncio
import contextlib
import logging
import os
import signal
import socket
import sys
import time
from asyncio.subprocess import DEVNULL, Process
from collections import Counter, deque
from dataclasses import replace
from typing import Final, Generic, Literal, TypeVar

import psutil

from resonator_daemon.base.errors import reason_of
from resonator_daemon.base.host.load import ProcessUsage
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.measure.decoder_process.connection import WorkerConnection
from resonator_daemon.measure.decoder_process.followed_contacts import FollowedContacts, no_contacts
from resonator_daemon.measure.decoder_process.messages import EndContacts, Reply, Results, SetUpStep, Undecodable, Work
from resonator_daemon.measure.sensors.surface_decoding import SurfaceClient
from resonator_daemon.measure.sensors.surface_stream import SurfaceFrame, SurfaceSettings
from resonator_daemon.mqtt.codec import Encoded
from resonator_daemon.mqtt.pacing import Backoff
from resonator_daemon.mqtt.payloads import ContactEvent, DecoderProcessInfo
from resonator_daemon.mqtt.topics import CONTACTS, DECODED, TOPICS

HUNG_S: Final = 5.0  # without a reply about a frame, which takes some ms
SET_UP_MAX_S: Final = 600.0  # of a start, or of one step of a set-up
RESTART_FIRST_S: Final = 0.5
RESTART_LONGEST_S: Final = 30.0
WAIT_MAX_NS: Final = 30_000_000  # of a frame while newer ones are there: a rebuild lasts some 10 ms
SOUND_S: Final = 60.0  # of running, after which the back-off starts from the beginning
_EXIT_S: Final = 1.0  # of a process that has closed its socket

Skipped = Literal["newer_frame", "too_old", "measured_late", "no_noise", "not_ready", "decoder_ended", "undecodable"]
Ending = Literal["crashed", "hung"]
_ENDINGS: Final[dict[Ending, ReasonCode]] = {
    "crashed": ReasonCode.DECODER_CRASHED,
    "hung": ReasonCode.DECODER_HUNG,
}
Origin = TypeVar("Origin")

# More threads of linear algebra cost more in waiting than they save on arrays of this size.
_ONE_THREAD: Final = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

log = logging.getLogger(__name__)


class DecoderSupervisor(Generic[Origin]):
    """Decoding by a child process; to be used from the event loop's thread only.

    At most one frame is with the process; the next ones wait in order. A frame that has waited for more than 30 ms is
    skipped if there is a newer one. Until the process is ready this is no loss by overload, and has another cause.
    At any instant, frames measured without fault = `decoded` + sum of `skipped` + `waiting`.

    Parameters
    ----------
    name
        Name of the plate, an argument of the process and in its log.
    settings
        Sent to each process that is started.
    client
        Receives the messages.

    Attributes
    ----------
    decoded
        Number of frames whose map was delivered.
    skipped
        Number of frames that were not decoded, by cause.
    restarts
        Number of restarts, by what ended the process before.
    """

    def __init__(self, name: str, settings: SurfaceSettings, client: SurfaceClient[Origin]) -> None:
        self._name = name
        self._settings = settings
        self._client = client
        self._contacts = FollowedContacts(settings.last_contact_id)
        self._connection: WorkerConnection | None = None
        self._usage: ProcessUsage | None = None
        self._is_idle = False
        self._present: Origin | None = None  # of the frame that the process has, until its map is there
        self._present_offered_ns = 0
        self._last: Origin | None = None  # of the frame that the process got last
        self._ready_ns: int | None = None  # since when the process decodes
        self._until_ready: Skipped = "not_ready"  # cause of frames that were offered before
        self._waiting: deque[tuple[Origin, Work]] = deque()
        self._interruption: Reason | None = None
        self._undecodable = False
        self._ending: asyncio.Future[Ending | None] | None = None
        self._deadline: asyncio.TimerHandle | None = None
        self.decoded = 0
        self.skipped: Counter[Skipped] = Counter()
        self.restarts: Counter[Ending] = Counter()

    @property
    def waiting(self) -> int:
        """Number of frames that are being decoded, or wait."""
        return (self._present is not None) + len(self._waiting)

    @property
    def frames_skipped(self) -> int:
        """Number of frames that were not decoded."""
        return self.skipped.total()

    @property
    def frames_late(self) -> int:
        """Number of frames that were not decoded in time."""
        return self.skipped["newer_frame"] + self.skipped["too_old"] + self.skipped["decoder_ended"]

    @property
    def last_contact_id(self) -> int:
        """The highest number of a contact so far."""
        return self._contacts.last_id

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

    def offer(self, origin: Origin, frame: SurfaceFrame) -> None:
        """Queue a frame for decoding; it is skipped when it waits for too long."""
        if self._undecodable:
            self.skipped["undecodable"] += 1
            return
        self._waiting.append((origin, Work(frame, time.monotonic_ns())))
        self._skip_old()
        self._send_next()

    def skip_late(self) -> None:
        """Count a frame that is not offered because it was measured too late."""
        self.skipped["measured_late"] += 1

    def interrupt(self, reason: Reason) -> None:
        """Release all contacts, because frames have stopped arriving; at once where there is no process."""
        if self._connection is None:
            self.release_contacts(reason)
            return
        self._interruption = reason
        self._send_next()

    def release_contacts(self, reason: Reason) -> None:
        """Release the contacts of a process that has ended, and publish that there are none."""
        if not self._contacts or self._last is None:
            return
        header = self._client.contacts_header(self._last)
        for event in self._contacts.release(header, reason):
            self._client.deliver_event(self._last, event)
        self._client.deliver(self._last, CONTACTS, no_contacts(header, reason, self._settings.decoder_id))

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
            self.skipped["undecodable" if self._undecodable else "decoder_ended"] += len(self._waiting)
            self._waiting.clear()

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
        connection.send(replace(self._settings, last_contact_id=self._contacts.last_id))
        self._expect_reply(SET_UP_MAX_S)
        return process

    def _disconnect(self) -> None:
        if self._connection is not None:
            self._connection.close()
        if self._deadline is not None:
            self._deadline.cancel()
        if self._present is not None:
            self.skipped["undecodable" if self._undecodable else "decoder_ended"] += 1
        self._connection = self._ending = self._present = self._usage = self._interruption = None
        self._is_idle = False
        self._ready_ns, self._until_ready = None, "decoder_ended"

    def _skip_old(self) -> None:
        """Skip frames that have waited for too long, but for the newest."""
        oldest_ns = time.monotonic_ns() - WAIT_MAX_NS
        while len(self._waiting) > 1 and self._waiting[0][1].offered_ns < oldest_ns:
            _, work = self._waiting.popleft()
            self._skip(work.offered_ns, "newer_frame")

    def _skip(self, offered_ns: int, cause: Skipped) -> None:
        """Count a frame that the process was too slow for, unless it came before the process was ready."""
        in_time = self._ready_ns is not None and offered_ns > self._ready_ns
        self.skipped[cause if in_time else self._until_ready] += 1

    def _send_next(self) -> None:
        if self._connection is None or not self._is_idle:
            return
        if self._interruption is not None:
            reason, self._interruption = self._interruption, None
            header = self._client.contacts_header(self._last) if self._contacts and self._last is not None else None
            self._connection.send(EndContacts(header, reason))
        elif self._waiting:
            self._skip_old()
            origin, work = self._waiting.popleft()
            self._present = self._last = origin
            self._present_offered_ns = work.offered_ns
            work.frame.header["lost"] = self._client.lost(origin)  # with the frames skipped since it was offered
            self._connection.send(work)
        else:
            return
        self._is_idle = False
        self._expect_reply(HUNG_S)

    def _received(self, reply: Reply) -> None:
        match reply:
            case Results():
                self._deliver(reply)
            case SetUpStep(step=""):
                log.info("decoder of %s is ready", self._name)
                self._client.announce(None)
                self._ready_ns = time.monotonic_ns()
                self._expect_reply(HUNG_S)
            case SetUpStep(step=step):
                log.info("decoder is being set up: %s", step)
                starting = Reason(ReasonCode.DECODER_STARTING, f"decoder is being set up: {step}")
                self._client.announce(starting)
                if self._ready_ns is not None:  # set up again while it runs
                    self._ready_ns, self._until_ready = None, "not_ready"
                self._expect_reply(SET_UP_MAX_S)
            case Undecodable(reason=reason):
                log.error("nothing is decoded: %s", reason)
                self._undecodable = True
                self._client.announce(Reason(ReasonCode.UNDECODABLE, f"nothing is decoded: {reason}"))
                self._end(None)

    def _deliver(self, results: Results) -> None:
        origin = self._last
        for message in results.messages:
            if origin is None:
                raise ValueError("results of no frame")
            if isinstance(message, ContactEvent):
                self._contacts.add_event(message)
                self._client.deliver_event(origin, message)
                continue
            topic = TOPICS[message.path]
            if topic is DECODED:
                self.decoded += 1
                self._present = None
            elif topic is CONTACTS:
                self._contacts.add_contacts(message.payload)
            self._client.deliver(origin, topic, Encoded(message.payload, message.t_ns))
        if results.outcome is None:
            return
        if results.outcome == "no_noise":
            self.skipped["no_noise"] += 1
        elif results.outcome == "too_old":
            self._skip(self._present_offered_ns, "too_old")
        self._present = None
        self._is_idle = True
        if self._deadline is not None:
            self._deadline.cancel()
        self._send_next()

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
