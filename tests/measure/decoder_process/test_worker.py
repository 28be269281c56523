"""What runs in the decoder process, over a socket pair in a thread: one request, its results, and its age."""

import pickle
import socket
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from decoder_bench import NOISE
from surface_bench import NOTHING, frame, header, settings

from resonator_daemon.estimate.surface.streaming import StreamingDecoder
from resonator_daemon.measure.decoder_process.worker import LENGTH, packed, work
from resonator_daemon.measure.sensors.surface_worker import (
    Reply,
    Request,
    Results,
    SetUpStep,
    SurfaceSettings,
    Work,
)


class Bench:
    """A worker in a thread, and the daemon's end of its socket."""

    def __init__(self) -> None:
        self._own, other = socket.socketpair()
        self._thread = threading.Thread(target=work, args=(other,))
        self._thread.start()
        self._replies = self._own.makefile("rb")

    def ask(self, request: SurfaceSettings | Request) -> list[Any]:
        """Send a request; return all replies up to its outcome."""
        self._own.sendall(packed(request))
        replies: list[Reply] = []
        while not any(isinstance(reply, Results) and reply.outcome for reply in replies):
            (length,) = LENGTH.unpack(self._replies.read(LENGTH.size))
            replies.append(pickle.loads(self._replies.read(length)))
        return replies

    def decode(self, seq: int, values: Any = NOTHING, *, within_ns: int = 10**11) -> str:
        """Ask for a frame that has some time left; return its outcome."""
        replies = self.ask(Work(frame(seq, values), time.monotonic_ns() + within_ns))
        return str(replies[-1].outcome)

    def close(self) -> None:
        self._replies.close()
        self._own.close()
        self._thread.join(30)
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


def test_rebuilds_rest_so_that_frames_have_the_processor(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    spans_ns: list[tuple[int, int]] = []

    def rebuild(_: StreamingDecoder) -> bool:
        began_ns = time.monotonic_ns()
        np.sort(np.random.default_rng(1).standard_normal(200_000))
        spans_ns.append((began_ns, time.monotonic_ns()))
        return True

    monkeypatch.setattr(StreamingDecoder, "rebuild", rebuild)
    while len(spans_ns) < 4:
        bench.decode(1)
    for (began_ns, ended_ns), (next_ns, _) in pairwise(spans_ns):
        assert next_ns - began_ns >= 3.0 * (ended_ns - began_ns)
