"""What runs in the decoder process, over a socket pair in a thread: one request, its results, and its age."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import pytest
from decoder_bench import NOISE
from surface_bench import NOTHING, frame, header, settings

from resonator_daemon.estimate.surface.streaming import StreamingDecoder
from resonator_daemon.measure.decoder_process.decoder_connection import DecoderConnection
from resonator_daemon.measure.decoder_process.worker import work
from resonator_daemon.measure.sensors.surface_requests import Reply, Request, Results, SetUpStep, SurfaceSettings, Work


class Bench:
    """A worker in a thread, and the daemon's end of its connection."""

    def __init__(self) -> None:
        self.connection, (self._other, memory_fd) = DecoderConnection.pair(settings())
        self.connection.socket.setblocking(True)
        other = DecoderConnection(self._other, memory_fd, is_daemon=False)
        self.is_open = True
        self._thread = threading.Thread(target=self._work, args=(other,))
        self._thread.start()

    def _work(self, connection: DecoderConnection) -> None:
        with suppress(EOFError):
            work(connection)

    def ask(self, request: SurfaceSettings | Request) -> list[Any]:
        """Send a request; return all replies up to its outcome."""
        self.connection.send(request)
        replies: list[Reply] = []
        while not any(isinstance(reply, Results) and reply.outcome for reply in replies):
            replies.append(self.connection.receive())
        return replies

    def decode(self, seq: int, *, within_ns: int = 10**11, is_last: bool = True) -> str:
        """Ask for a frame that has some time left; return its outcome."""
        replies = self.ask(Work(frame(seq, NOTHING), time.monotonic_ns() + within_ns, is_last=is_last))
        return str(replies[-1].outcome)

    def close(self) -> None:
        self.is_open = False
        self.connection.socket.close()
        self._thread.join(30)
        self._other.close()
        assert not self._thread.is_alive()


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    try:
        assert bench.ask(settings()) == [Results((), "ready")]
        assert bench.decode(0) == "decoded"
        yield bench
    finally:
        bench.close()


def test_the_map_goes_out_before_the_contacts_are_read(bench: Bench) -> None:
    first, rest = bench.ask(Work(frame(1, NOTHING), 1 << 62))
    assert ([path for path, _ in first.messages], first.outcome) == (["decoded"], None)
    assert [path for path, _ in rest.messages] == ["decoded/summary", "contacts"]
    assert rest.outcome == "decoded"
    assert {message.t_ns for _, message in (*first.messages, *rest.messages)} == {header(1)["t_ns"]}


def test_a_frame_that_is_too_old_is_not_decoded(bench: Bench) -> None:
    assert bench.decode(1, within_ns=-1) == "too_old"
    assert bench.decode(2) == "decoded"


def test_steps_of_a_set_up_come_as_they_begin(bench: Bench) -> None:
    replies = bench.ask(Work(frame(1, NOTHING, 8.0 * NOISE), 1 << 62))
    steps = [reply.step for reply in replies if isinstance(reply, SetUpStep)]
    assert (steps[0], steps[-1]) == ("looking in the cache", "")


def test_frames_are_decoded_before_an_update_and_between_its_parts(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    during, frames = threading.Event(), list[int]()

    def rebuild(_: StreamingDecoder, pause: Callable[[], None]) -> bool:
        during.set()
        while len(frames) < 5 and bench.is_open:
            pause()
        return True

    monkeypatch.setattr(StreamingDecoder, "rebuild", rebuild)
    for seq in (1, 2):
        assert bench.decode(seq, is_last=False) == "decoded"
        frames.append(seq)
        assert not during.is_set()  # no update while a frame waits
    for seq in (3, 4, 5):
        assert bench.decode(seq) == "decoded"
        assert during.wait(30)
        frames.append(seq)
