"""Measurement of some seconds of a board: its identity, what it counts, and the fate of its bytes."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from firmware_protocol.layouts import MessageType
from firmware_protocol.messages import BoardStatus, MalformedMessageError, decode_message
from firmware_protocol.packets import Packet, PacketDecoder
from resonator_daemon.doctor.host import Host
from resonator_daemon.doctor.load import Load
from resonator_daemon.doctor.plate_readings import FEWEST_FRAMES, PlateReading, plate_reading
from resonator_daemon.links.target import LinkTarget
from resonator_daemon.plate import Plate
from resonator_daemon.sensors.expected_tones import ExpectedTones
from resonator_daemon.sensors.kinds import sensor_of
from resonator_daemon.session.blocking_reader import BlockingReader
from resonator_daemon.session.compatibility import oscillator_hz
from resonator_daemon.session.counters import LinkCounters
from resonator_daemon.session.frames import (
    BoardOnline,
    BoardRefused,
    ChannelisedFrame,
    LinkChange,
    ReaderFailed,
    SingleToneFrame,
)
from resonator_daemon.session.link_events import Received, WireEvent
from resonator_daemon.tones.tone_detector import reading_frames

OPEN_S: Final = 6.0  # in which a board must count
_TURN_S: Final = 0.1

Progress = Callable[[str], None]


@dataclass
class Capture:
    """Result of some seconds of a board.

    Attributes
    ----------
    before, after
        The link's counters at the first frame and at the end; equal where no frame came.
    interruptions, losses
        Reasons of the link whenever frames stopped, and whenever the link itself was lost.
    busy
        Sentence on a computer that was too busy to read in time; empty where it was not.
    problems
        Why the board cannot serve the plate, as it reported itself or as its ticks have shown.
    temperatures_kelvin
        As the board reports them; empty where it does not.
    """

    frame_rate_hz: float = 0.0  # that the plate asks for
    seconds: float = 0.0
    board: BoardOnline | None = None
    link: str = ""
    tones: ExpectedTones | None = None
    readings: list[PlateReading] = field(default_factory=list)
    before: LinkCounters = field(default_factory=LinkCounters)
    after: LinkCounters = field(default_factory=LinkCounters)
    interruptions: list[str] = field(default_factory=list)
    losses: list[str] = field(default_factory=list)
    busy: str = ""
    problems: tuple[str, ...] = ()
    temperatures_kelvin: list[float] = field(default_factory=list)

    @property
    def frames(self) -> int:
        return self.after.frames - self.before.frames

    @property
    def stopped(self) -> bool:
        """Whether frames stopped coming for a while."""
        return bool(self.interruptions or self.losses)

    @property
    def counted(self) -> bool:
        return self.seconds > 0.0


class _StatusDecoder:
    """Collects the status messages of a board; called from the reader's thread."""

    def __init__(self) -> None:
        self._decoder = PacketDecoder(from_board=True)
        self.messages: list[BoardStatus] = []

    def put(self, event: WireEvent) -> None:
        if not isinstance(event, Received):
            return
        for packet in self._decoder.feed(event.data):
            if isinstance(packet, Packet) and packet.type == MessageType.STATUS:
                try:
                    self.messages.append(decode_message(BoardStatus, packet.payload))
                except MalformedMessageError:
                    continue  # the link's account has it


def capture_board(target: LinkTarget, plate: Plate, seconds: float, progress: Progress, host: Host) -> Capture:
    """Capture `seconds` of a board from its first frame on.

    Raises
    ------
    Exception
        What the reader's thread failed with, which is a mistake of ours.
    """
    status = _StatusDecoder()
    loop = BlockingReader(target, plate, any_unit=True, on_event=status.put)  # another unit is reported beside the rest
    reader = loop.reader
    capture = Capture(plate.counter.frame_rate_hz)
    with Load(host) as load, loop:
        _capture(loop, capture, plate, seconds, progress)
    capture.busy = load.busy()
    if capture.counted:
        capture.after = reader.counters()
    else:
        capture.before = capture.after = reader.counters()
    kelvin = (message.temperature_millikelvin for message in status.messages)
    capture.temperatures_kelvin = [value * 1e-3 for value in kelvin if value is not None]
    return capture


def _capture(loop: BlockingReader, capture: Capture, plate: Plate, seconds: float, progress: Progress) -> None:
    reader, sensor = loop.reader, sensor_of(plate)
    frames = reading_frames(1 / plate.counter.frame_rate_hz, FEWEST_FRAMES)
    expected, detector = sensor.expected_tones, None
    begun_s = time.monotonic()
    first_s: float | None = None
    while True:
        arrivals = loop.wait(_TURN_S)
        now_s = time.monotonic()
        for arrival in arrivals:
            match arrival:
                case SingleToneFrame() | ChannelisedFrame():
                    if first_s is None:
                        first_s = now_s
                        capture.before = reader.counters()
                    if detector is not None and (reading := detector.push(arrival)) is not None:
                        capture.readings.append(plate_reading(reading, expected))
                case BoardOnline():
                    capture.board = arrival
                    if detector is None:
                        capture.tones = expected
                        detector = sensor.tone_detector(frames, oscillator_hz(arrival.description))
                case LinkChange():
                    capture.link = arrival.reason
                    if first_s is not None and arrival.state == "stalled":
                        capture.interruptions.append(arrival.reason)
                    if first_s is not None and arrival.state == "lost":
                        capture.losses.append(arrival.reason)
                case BoardRefused():
                    capture.problems = arrival.problems
                case ReaderFailed():
                    raise arrival.error
        if capture.problems:
            return
        if first_s is None:
            if now_s - begun_s > OPEN_S:
                return
        else:
            capture.seconds = now_s - first_s
            progress(f"{reader.counters().frames} frames, {min(capture.seconds, seconds):.0f} of {seconds:g} s")
            if capture.seconds >= seconds:
                return
