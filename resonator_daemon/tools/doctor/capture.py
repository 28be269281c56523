"""Measurement of some seconds of a board: its tones, and the outcome of its bytes."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from firmware_protocol.layouts import MessageType
from firmware_protocol.messages import BoardStatus, MalformedMessageError, decode_message
from firmware_protocol.packets import Packet, PacketDecoder
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import Reason
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.board.session.counters import LinkCounters
from resonator_daemon.board.session.frames import BoardRefused, ChannelisedFrame, LinkChange, SingleToneFrame
from resonator_daemon.board.session.link_events import Received, WireEvent
from resonator_daemon.measure.pipeline.tone_capture import ToneCapture
from resonator_daemon.measure.sensors.expected_tones import ExpectedTones
from resonator_daemon.measure.sensors.kinds import sensor_of
from resonator_daemon.tools.doctor.host import Host, Load
from resonator_daemon.tools.doctor.plate_readings import FEWEST_FRAMES, PlateReading, plate_reading

OPEN_S: Final = 6.0  # in which a board must count

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

    frame_rate_hz: float  # that the plate asks for
    tones: ExpectedTones
    seconds: float = 0.0
    link: str = ""
    readings: list[PlateReading] = field(default_factory=list)
    before: LinkCounters = field(default_factory=LinkCounters)
    after: LinkCounters = field(default_factory=LinkCounters)
    interruptions: list[str] = field(default_factory=list)
    losses: list[str] = field(default_factory=list)
    busy: str = ""
    problems: tuple[Reason, ...] = ()
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
    tones = ToneCapture(target, plate, fewest_frames=FEWEST_FRAMES, on_event=status.put)
    capture = Capture(plate.counter.frame_rate_hz, sensor_of(plate).expected_tones)
    with Load(host) as load, tones:
        _capture(tones, capture, seconds, progress)
    capture.busy = load.busy()
    capture.after = tones.reader.counters()
    if not capture.counted:
        capture.before = capture.after
    kelvin = (message.temperature_millikelvin for message in status.messages)
    capture.temperatures_kelvin = [value * 1e-3 for value in kelvin if value is not None]
    return capture


def _capture(tones: ToneCapture, capture: Capture, seconds: float, progress: Progress) -> None:
    begun_s = time.monotonic()
    first_s: float | None = None
    for arrival, reading in tones.arrivals():
        if reading is not None:
            capture.readings.append(plate_reading(reading, capture.tones))
        match arrival:
            case SingleToneFrame() | ChannelisedFrame() if first_s is None:
                first_s = time.monotonic()
                capture.before = tones.reader.counters()
            case LinkChange():
                capture.link = arrival.reason.text
                if first_s is not None and arrival.state == "stalled":
                    capture.interruptions.append(arrival.reason.text)
                if first_s is not None and arrival.state == "lost":
                    capture.losses.append(arrival.reason.text)
            case BoardRefused():
                capture.problems = arrival.problems
                return
            case None if first_s is not None:
                capture.seconds = time.monotonic() - first_s
                shown_s = min(capture.seconds, seconds)
                progress(f"{tones.reader.counters().frames} frames, {shown_s:.0f} of {seconds:g} s")
                if capture.seconds >= seconds:
                    return
            case None if time.monotonic() - begun_s > OPEN_S:
                return
