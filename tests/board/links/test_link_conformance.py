"""What every link must do, whatever carries it.

The same over a real board, which is left quiet:

    RESONATOR_TEST_LINK="serial:/dev/ttyACM0?baud=4000000" pytest -m hardware tests/board/links/test_link_conformance.py
"""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from link_bench import WAIT_S, Bench, Host, LocalHost, bench

from firmware_protocol.host import Described, Frame, HostSession, Pong
from firmware_protocol.messages import Configuration, Description
from firmware_protocol.states import HostState
from resonator_daemon.board.links.link import Link, LinkLostError, LinkUnavailableError

EMULATED = ("serial", "tcp", "usb")
RECORDS = bytes(range(176))


@pytest.fixture
def emulated(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    """A link with an emulated board, which a test may command."""
    with bench(request.param, tmp_path) as ready:
        yield ready


@pytest.fixture
def host(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Host]:
    """The host's side of a link with any board."""
    if request.param == "hardware":
        link = os.environ.get("RESONATOR_TEST_LINK")
        assert link, "RESONATOR_TEST_LINK must name the link, as serial:/dev/ttyACM0?baud=4000000"
        yield LocalHost(link)
        return
    with bench(request.param, tmp_path) as ready:
        yield ready.host


every_link = pytest.mark.parametrize(
    "host", [*EMULATED, pytest.param("hardware", marks=pytest.mark.hardware)], indirect=True
)
every_emulated_link = pytest.mark.parametrize("emulated", EMULATED, indirect=True)


class Talk:
    """A session over an open link, for as long as an answer is awaited."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.session = HostSession()
        self.described: Described | None = None
        self.frames: list[Frame] = []
        self.pongs: list[bytes] = []

    def exchange(self) -> None:
        if data := self.session.data_to_send():
            self.link.write(data)
        received = self.link.read(0.3)
        if not received:
            self.session.ask_again()
        for event in self.session.receive(received):
            match event:
                case Described():
                    self.described = event
                case Frame():
                    self.frames.append(event)
                case Pong():
                    self.pongs.append(event.opaque)

    def describe(self) -> Described:
        while self.described is None:
            self.exchange()
        return self.described

    def start(self) -> None:
        self.session.configure(Configuration(gate_ticks(self.describe().description)))
        while self.session.state is not HostState.RUNNING:
            self.exchange()

    def stop(self) -> None:
        """Leave the board quiet."""
        self.session.stop()
        self.link.write(self.session.data_to_send())
        while self.link.read(0.3):
            pass


def gate_ticks(description: Description) -> int:
    """A gate of 10 ms, or what the board can make of it."""
    step = description.gate_ticks_step
    wanted = description.reference_millihertz // 1000 // 100 // step * step
    return min(max(wanted, description.gate_ticks_min), description.gate_ticks_max)


def open_when_it_is_back(host: Host) -> Link:
    deadline = time.monotonic() + WAIT_S
    while True:
        try:
            return host.open()
        except LinkUnavailableError:  # as of a USB device that is not numbered yet
            if time.monotonic() > deadline:
                raise


def lose(link: Link) -> None:
    """Read until the loss is told; what was on its way before may come first."""
    with pytest.raises(LinkLostError):  # noqa: PT012 - how many pieces come is not known
        while True:
            link.read(WAIT_S)


@every_link
def test_every_byte_value_passes_both_ways(host: Host) -> None:
    link = host.open()
    talk = Talk(link)
    talk.describe()
    sent = [bytes(range(start, start + 8)) for start in range(0, 256, 8)]
    for opaque in sent:
        assert talk.session.ping(opaque)
        while opaque not in talk.pongs:
            talk.exchange()
    link.close()
    assert talk.pongs == sent


@pytest.mark.hardware
@pytest.mark.parametrize("host", ["hardware"], indirect=True)
def test_frames_of_a_board_come_in_order_and_without_a_gap(host: Host) -> None:
    link = host.open()
    talk = Talk(link)
    talk.start()
    while len(talk.frames) < 100:
        talk.exchange()
    talk.stop()
    link.close()
    first = talk.frames[0].sequence
    assert [frame.sequence for frame in talk.frames] == list(range(first, first + len(talk.frames)))


@every_emulated_link
def test_a_megabyte_comes_whole_while_requests_go_out(emulated: Bench) -> None:
    data = bytes(range(251)) * 4000  # of a period that no buffer's size divides
    link = emulated.host.open()
    emulated.board.send(data)
    received = b""
    while len(received) < len(data):
        link.write(b"request")
        piece = link.read(WAIT_S)
        assert piece
        received += piece
    written = emulated.board.received
    link.close()
    assert received == data
    assert written == (b"request" * len(written))[: len(written)]


@every_emulated_link
def test_nothing_is_no_loss(emulated: Bench) -> None:
    link = emulated.host.open()
    assert link.read(0.0) == b""
    assert link.read(0.05) == b""
    assert link.overruns == 0
    link.write(b"")
    emulated.board.send(b"late")
    assert link.read(WAIT_S) == b"late"
    link.close()


@every_emulated_link
def test_unplugged_is_told_every_time_and_the_port_comes_back(emulated: Bench) -> None:
    emulated.host.open().close()
    before = emulated.host.descriptors()
    link = emulated.host.open()
    for _ in range(3):
        emulated.board.unplug()
        lose(link)
        with pytest.raises(LinkLostError):
            link.read(WAIT_S)
        with pytest.raises(LinkLostError):  # noqa: PT012 - a network may take some before it tells
            while True:
                link.write(bytes(1000))
        link.close()
        link.close()
        with pytest.raises(LinkUnavailableError):
            emulated.host.open()
        emulated.board.plug_in()
        link = open_when_it_is_back(emulated.host)
        Talk(link).describe()
    link.close()
    assert emulated.host.descriptors() == before


@every_link
def test_opening_again_and_again_leaves_nothing_behind(host: Host) -> None:
    def once() -> None:
        link = host.open()
        Talk(link).describe()
        link.close()

    once()  # what is loaded at the first time stays
    before = host.descriptors()
    for _ in range(5):
        once()
    assert host.descriptors() == before
