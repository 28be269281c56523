"""Checks of board and link: answers, tick rate, and frames that are damaged or lost."""

import math
from collections.abc import Iterator
from typing import Final

from firmware_protocol.messages import ResetCause
from resonator_daemon.base.host.load import REMEDY
from resonator_daemon.base.host.text import page
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.session.clock import TOLERANCE_PPM
from resonator_daemon.board.session.compatibility import first_of, incompatibilities
from resonator_daemon.board.session.link_reasons import all_of
from resonator_daemon.board.session.probe import ProbeResult, round_trip_s
from resonator_daemon.tools.doctor.capture import OPEN_S, Capture
from resonator_daemon.tools.doctor.finding import Amount, Area, Check, Finding, Outcome, excused, graded, not_checked

OPENS: Final = Check("link.opens", Area.WIRING, "link")
ANSWERS: Final = Check("board.answers", Area.WIRING, "board answers")
RESPONDS: Final = Check("board.answers", Area.SENSOR, "board answers")  # the board is there, and answers something else
MESSAGES: Final = Check("board.messages", Area.SENSOR, "messages of the board")  # intact packets with wrong contents
PINGS: Final = Check("board.pings", Area.SENSOR, "answers to pings")
FITS: Final = Check("board.fits", Area.SENSOR, "board and plate file")
UNIT: Final = Check("board.unit", Area.SENSOR, "board that was calibrated")
REFERENCE: Final = Check("board.reference", Area.SENSOR, "reference of the board")
ROUND_TRIP: Final = Check("link.round_trip", Area.WIRING, "round trip to the board")
RESET: Final = Check("board.reset", Area.WIRING, "last reset of the board")

FRAMES: Final = Check("board.frames", Area.SENSOR, "frames of the board")
COUNTS: Final = Check("board.counts", Area.SENSOR, "board sends frames")
STEADY: Final = Check("link.steady", Area.WIRING, "link stays")
ERRORS: Final = Check("link.errors", Area.WIRING, "errors on the cable")
OVERFLOW: Final = Check("link.overflow", Area.WIRING, "frames that the board dropped")
_OVERFLOW_OF_THIS_COMPUTER: Final = Check("link.overflow", Area.SOFTWARE, "frames that the board dropped")
COMPUTER_BUSY: Final = Check(ReasonCode.COMPUTER_BUSY, Area.SOFTWARE, "load of this computer")
OVERRUN: Final = Check("host.overrun", Area.SOFTWARE, "bytes that the driver lost")
OF_A_PROBE: Final = (FITS, UNIT, REFERENCE, ROUND_TRIP, RESET)
OF_A_CAPTURE: Final = (COUNTS, STEADY, ERRORS, OVERFLOW, OVERRUN)

_ROUND_TRIP_S: Final = 0.005  # median; an FTDI timer of 16 ms, its default, gives 8 ms more
_ERRORS_WARNING, ERRORS_FAULT = 0.0, 1e-3  # frames damaged or lost, of all
_RATE_LEAST: Final = 0.8  # of the frames that the plate asks for, before the board must be dropping them
_GARBAGE_FAULT: Final = 1e-3  # bytes discarded, of all
_HITS_LEAST, _GARBAGE_LEAST_BYTES = 3, 1024  # fewer are chance, or packets that were cut when the port was opened


def check_probe(probed: ProbeResult, plate: Plate | None, busy: str = "") -> Iterator[Finding]:
    """Yield the findings on a board's answers, without its frames; `busy` explains answers that come late."""
    identity = probed.described.identity
    yield ANSWERS.ok(f"{identity.product} {identity.serial_number}, firmware {identity.firmware}")
    if plate is None:
        yield FITS.not_checked(
            "no configuration names the plate, and no shipped one bears the name that the board gives"
        )
        yield UNIT.not_checked("no plate file")
    else:
        yield _fits(probed, plate)
        yield _unit(probed, plate)
    yield _reference(probed)
    yield excused(_round_trip(probed), busy if probed.round_trips_s else "")  # late answers, not missing ones
    yield _reset(probed)


def check_capture(capture: Capture) -> Iterator[Finding]:
    """Yield the findings on frames and bytes while the board counted."""
    if not capture.counted:
        yield from _nothing_came(capture)
        return
    yield COUNTS.ok(f"{capture.frames} frames in {capture.seconds:.1f} s")
    overruns = capture.after.host_overruns - capture.before.host_overruns
    yield excused(_errors(capture), "the driver lost bytes, which has the same effect" if overruns else "")
    steady, dropped = _steady(capture), _overflow(capture)
    explained = (dropped,) if capture.losses else (steady, dropped)
    if capture.busy and any(finding.outcome in (Outcome.FAULT, Outcome.NOT_CHECKED) for finding in explained):
        yield COMPUTER_BUSY.fault(capture.busy, REMEDY)
    yield excused(steady, "" if capture.losses else capture.busy)
    yield dropped
    yield OVERRUN.judged(
        graded(overruns, 0.0, 0.0),
        f"{overruns} times, expected: none" if overruns else "none that it reports",
        "relieve the computer: something delays its interrupts",
        Amount(float(overruns), 0.0, "times"),
    )


def _steady(capture: Capture) -> Finding:
    stops = (*capture.losses, *capture.interruptions)
    if not stops:
        return STEADY.ok("frames came without interruption")
    return STEADY.fault(
        f"frames stopped {len(stops)} times in {capture.seconds:.1f} s: {stops[0]}",
        PLUG,
        Amount(float(len(stops)), 0.0, "interruptions"),
    )


def _nothing_came(capture: Capture) -> Iterator[Finding]:
    rest = (STEADY, OVERFLOW, OVERRUN)
    account = capture.after
    if capture.problems:
        codes = [problem.code for problem in capture.problems]
        check = REFERENCE if ReasonCode.WRONG_REFERENCE in codes else FITS
        yield check.fault(all_of(capture.problems).text, "connect the right board, or name the right plate file")
        yield from not_checked((COUNTS, ERRORS, *rest), "the board does not serve this plate")
    elif account.bytes_discarded > _GARBAGE_FAULT * max(account.bytes_received, 1):
        yield _garbage(account.bytes_discarded, account.bytes_received, 0, 0)
        yield from not_checked((COUNTS, *rest), "too little arrives undamaged")
    elif refusals := account.refusals.most_common(1):
        ((refused, count),) = refusals
        yield FRAMES.fault(
            f"{count} packets are refused ({refused.code}): {refused.text}",
            FIRMWARE,
            Amount(float(count), 0.0, "packets"),
        )
        yield from not_checked((COUNTS, ERRORS, *rest), "no frame could be read")
    else:
        yield COUNTS.fault(
            f"it answers, and no frame came within {OPEN_S:g} s: {capture.link}",
            "restart the board; if that does not help, it or its firmware is broken",
        )
        yield from not_checked((ERRORS, *rest), "no frame came")


def _overflow(capture: Capture) -> Finding:
    dropped = capture.after.lost.board_overflow - capture.before.lost.board_overflow
    rate_hz = _all_frames(capture) / capture.seconds
    if dropped or rate_hz >= _RATE_LEAST * capture.frame_rate_hz or capture.stopped:
        return overflow(dropped, _all_frames(capture), capture.busy)
    too_slow = OVERFLOW.fault(
        f"{rate_hz:.0f} of {capture.frame_rate_hz:g} frames per second arrive: the queue of the board fills",
        _CAPACITY,
        Amount(rate_hz, _RATE_LEAST * capture.frame_rate_hz, "Hz"),
    )
    return excused(too_slow, capture.busy)


def overflow(dropped: int, frames: int, busy: str = "") -> Finding:
    """Return the finding on dropped frames, of all frames; `busy` names this computer as the cause."""
    evidence = f"{dropped} of {frames} frames, expected: none"
    return (_OVERFLOW_OF_THIS_COMPUTER if busy else OVERFLOW).judged(
        graded(dropped / frames, _ERRORS_WARNING, ERRORS_FAULT),
        f"{evidence}; {busy}" if busy and dropped else evidence,
        REMEDY if busy else _CAPACITY,
        Amount(float(dropped), 0.0, "frames"),
    )


def _errors(capture: Capture) -> Finding:
    before, after = capture.before, capture.after
    hit = after.lost.damaged - before.lost.damaged
    if not capture.stopped:  # else the frames in between count as a gap
        hit += after.lost.link_gap - before.lost.link_gap
    hit += after.parts_lost - before.parts_lost
    discarded = after.bytes_discarded - before.bytes_discarded
    received = after.bytes_received - before.bytes_received
    frames = _all_frames(capture)
    many = hit >= _HITS_LEAST and hit / frames > ERRORS_FAULT
    if many or discarded > max(_GARBAGE_FAULT * received, _GARBAGE_LEAST_BYTES):
        return _garbage(discarded, received, hit, frames)
    evidence = f"{hit} of {frames} frames damaged or lost (limit {ERRORS_FAULT:g}), {discarded} of {received} bytes"
    return ERRORS.judged(graded(hit + discarded, 0.0, math.inf), evidence, CABLE, Amount(hit / frames, ERRORS_FAULT))


_CAPACITY: Final = (
    "the link carries less than the board sends: raise the baud rate on both ends, use a quicker port, or lower "
    "counter.frame_rate_hz of the plate"
)
PLUG: Final = "check plug, cable, hub and the board's power: move the cable and watch"
FIRMWARE: Final = "update the board's firmware: what it sends does not have the form that PROTOCOL.md gives"
CABLE: Final = (
    "exchange the cable, keep it away from motors, ground both ends; on a line with a baud rate, see that both ends "
    "have the same"
)


def _garbage(discarded: int, received: int, hit: int, frames: int) -> Finding:
    share = hit / frames if frames else 1.0
    of_frames = f"{hit} of {frames} frames damaged or lost (limit {ERRORS_FAULT:g}), " if frames else "no whole frame, "
    return ERRORS.fault(
        f"{of_frames}{discarded} of {received} bytes are no packets (limit {_GARBAGE_FAULT:g})",
        CABLE,
        Amount(share, ERRORS_FAULT),
    )


def _all_frames(capture: Capture) -> int:
    return max(1, capture.frames + capture.after.lost.total - capture.before.lost.total)


def _fits(probed: ProbeResult, plate: Plate) -> Finding:
    problems = incompatibilities(probed.described.description, plate)
    if problems:
        return FITS.fault(first_of(problems).text, "connect the right board, or name the right plate file")
    return FITS.ok(f"the board measures what plate {plate.name} needs")


def _unit(probed: ProbeResult, plate: Plate) -> Finding:
    unit, present = plate.calibration.unit, probed.described.identity.serial_number
    if unit is None:
        return UNIT.not_checked("the plate file does not name the board with which it was calibrated")
    if unit != present:
        return UNIT.fault(
            f"the plate file was calibrated with {unit}, {present} is connected",
            f"connect {unit}, or name the plate file of {present}",
        )
    return UNIT.ok(unit)


def _reference(probed: ProbeResult) -> Finding:
    rate = probed.tick_rate
    if rate is None:
        return REFERENCE.not_checked("its ticks could not be timed")
    evidence = (
        f"ticks come {rate.deviation_ppm:+.0f} ppm off by this computer's clock, give or take "
        f"{rate.uncertainty_ppm:.0f}; at most {TOLERANCE_PPM:g} ppm are plausible"
    )
    if rate.plausible:
        return REFERENCE.ok(evidence, Amount(rate.deviation_ppm, float(TOLERANCE_PPM), "ppm"))
    return REFERENCE.fault(
        f"{evidence}: forces would be wrong by as much",
        "repair the board's reference oscillator, or its frequency in the firmware; check this computer's clock",
        Amount(rate.deviation_ppm, float(TOLERANCE_PPM), "ppm"),
    )


def _round_trip(probed: ProbeResult) -> Finding:
    times_s = round_trip_s(probed)
    if times_s is None:
        return PINGS.fault("it identifies itself, and answers no ping", FIRMWARE)
    shortest_s, median_s = times_s
    evidence = f"{shortest_s * 1e3:.2f} ms at best, {median_s * 1e3:.2f} ms median (limit {_ROUND_TRIP_S * 1e3:g})"
    return ROUND_TRIP.judged(
        graded(median_s, _ROUND_TRIP_S, math.inf),
        evidence,
        f"an adapter that collects bytes: shorten its latency timer ({page('how-to/connect.md')}); "
        "of TCP, check the network",
        Amount(median_s * 1e3, _ROUND_TRIP_S * 1e3, "ms"),
    )


def _reset(probed: ProbeResult) -> Finding:
    cause = probed.described.identity.reset_cause
    if cause == ResetCause.BROWN_OUT:
        return RESET.warning(
            "its supply had broken down", "check the board's power: a shorter cable, another port, a hub with a supply"
        )
    if cause == ResetCause.WATCHDOG:
        return RESET.warning("its watchdog had restarted it", "update its firmware; report it to its maker")
    name = ResetCause(cause).name.lower().replace("_", " ") if cause in set(ResetCause) else f"cause {cause}"
    return RESET.ok(name)
