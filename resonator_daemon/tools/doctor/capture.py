"""Measurement of some seconds of a board: its tones against those that the plate should send, and its bytes."""

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from firmware_protocol.layouts import CHANNEL_COUNT, MessageType
from firmware_protocol.messages import BoardStatus, MalformedMessageError, decode_message
from firmware_protocol.packets import Packet, PacketDecoder
from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import Reason
from resonator_daemon.board.links.target import LinkTarget
from resonator_daemon.board.session.frames import (
    BoardRefused,
    ChannelisedFrame,
    LinkChange,
    LinkCounters,
    SingleToneFrame,
)
from resonator_daemon.board.session.link_events import Received, WireEvent
from resonator_daemon.estimate.tones.tone_detector import ToneReading
from resonator_daemon.measure.pipeline.tone_capture import ToneCapture
from resonator_daemon.measure.sensors.base import sensor_of
from resonator_daemon.measure.sensors.expected_tones import ExpectedTones
from resonator_daemon.tools.doctor.host_checks import BusyCheck, Host

OPEN_S: Final = 6.0  # in which a board must count
FEWEST_FRAMES: Final = 3  # of a reading


@dataclass(frozen=True, slots=True)
class PlateReading:
    """A tenth of a second: of t tones that were expected, arrays (t, 4); NaN where one was not counted.

    Attributes
    ----------
    shift
        Relative, against the plate file: f / f0 - 1.
    std
        Relative, that noise of counter and oscillator give it.
    strange_hz
        (4,): frequency that is neither an expected tone nor a site's; NaN where there is none.
    touched
        Whether a site is counted in the place of the pilot.
    scatter_radian
        (4,): standard deviation of an edge, as phase of the tone; NaN of a counter that has no edges.
    gates_counted
        (4,): share of gates in which a channel counts a tone, whether it runs on from the gate before or not.
    """

    time_s: float
    shift: Floats
    std: Floats
    strange_hz: Floats
    touched: bool
    scatter_radian: Floats
    gates_counted: Floats


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


def capture_board(
    target: LinkTarget, plate: Plate, seconds: float, progress: Callable[[str], None], host: Host
) -> Capture:
    """Capture `seconds` of a board from its first frame on.

    Raises
    ------
    Exception
        What the reader's thread failed with.
    """
    capture = Capture(plate.counter.frame_rate_hz, sensor_of(plate).expected_tones)
    decoder = PacketDecoder(from_board=True)

    def read_temperature(event: WireEvent) -> None:  # in the reader's thread
        for packet in decoder.feed(event.data) if isinstance(event, Received) else ():
            if isinstance(packet, Packet) and packet.type == MessageType.STATUS:
                with suppress(MalformedMessageError):  # the link counts it
                    millikelvin = decode_message(BoardStatus, packet.payload).temperature_millikelvin
                    capture.temperatures_kelvin += [] if millikelvin is None else [millikelvin * 1e-3]

    tones = ToneCapture(target, plate, fewest_frames=FEWEST_FRAMES, on_event=read_temperature)
    with BusyCheck(host) as busy_check, tones:
        _capture(tones, capture, seconds, progress)
    capture.busy = busy_check.reason()
    capture.after = tones.reader.counters()
    if not capture.counted:
        capture.before = capture.after
    return capture


def _capture(tones: ToneCapture, capture: Capture, seconds: float, progress: Callable[[str], None]) -> None:
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


def plate_reading(reading: ToneReading, expected: ExpectedTones) -> PlateReading:
    """Return a tone reading against the tones of a plate."""
    shift = reading.frequency_hz / expected.f0_hz - 1.0
    std = np.hypot(reading.std, reading.oscillator_std)
    strange_hz = np.full(CHANNEL_COUNT, math.nan)
    touched = False
    if expected.pressed_hz is not None:
        lowest_hz, highest_hz = expected.pressed_hz
        (tone_hz,), off = reading.frequency_hz, np.abs(shift[0]) >= expected.band[0]
        of_site = off & ((lowest_hz <= tone_hz) & (tone_hz <= highest_hz)).any(axis=0)
        touched = bool(of_site.any())
        strange_hz = np.where(off & ~of_site, tone_hz, math.nan)
        shift, std = np.where(off, math.nan, shift), np.where(off, math.nan, std)
    return PlateReading(
        reading.time_s,
        shift,
        std,
        strange_hz,
        touched,
        reading.scatter_radian,
        np.isfinite(reading.gate_hz).mean(axis=(0, 2)),
    )
