"""Checks of board and link: answers, tick rate, and frames that are damaged or lost."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

from firmware_protocol.messages import ResetCause
from resonator_daemon.base.host.load import REMEDY
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.board.session.clock import TOLERANCE_PPM
from resonator_daemon.board.session.compatibility import first_of, incompatibilities
from resonator_daemon.board.session.link_state import all_of
from resonator_daemon.board.session.probe import ProbeResult, TickRate, round_trip_s
from resonator_daemon.tools.doctor.capture import OPEN_S, Capture
from resonator_daemon.tools.doctor.finding import Amount, Area, Finding, Outcome, downgraded, make_check, not_checked

ERRORS_FAULT: Final = 1e-3  # frames damaged or lost, of all

OPENS: Final = make_check("link.opens")
ANSWERS: Final = make_check("board.answers")
# The board is there, and answers something else.
RESPONDS: Final = replace(ANSWERS, area=Area.SENSOR)
# Intact packets with wrong contents.
MESSAGES: Final = make_check("board.messages")
PINGS: Final = make_check("board.pings")
FITS: Final = make_check("board.fits")
UNIT: Final = make_check("board.unit")
REFERENCE: Final = make_check("board.reference", "ppm", fault_above=float(TOLERANCE_PPM))
# median; an FTDI timer of 16 ms, its default, gives 8 ms more
ROUND_TRIP: Final = make_check("link.round_trip", "ms", warning_above=5.0)
RESET: Final = make_check("board.reset")
FRAMES: Final = make_check("board.frames", "packets", fault_above=0.0)
COUNTS: Final = make_check("board.counts")
STEADY: Final = make_check("link.steady", "interruptions", fault_above=0.0)
ERRORS: Final = make_check("link.errors", warning_above=0.0, fault_above=ERRORS_FAULT)
OVERFLOW: Final = make_check("link.overflow", "frames", warning_above=0.0, fault_above=ERRORS_FAULT)
_OVERFLOW_OF_THIS_COMPUTER: Final = replace(OVERFLOW, area=Area.SOFTWARE, remedy=REMEDY)
COMPUTER_BUSY: Final = replace(make_check(ReasonCode.COMPUTER_BUSY), remedy=REMEDY)
OVERRUN: Final = make_check("host.overrun", "times", fault_above=0.0)
OF_A_PROBE: Final = (FITS, UNIT, REFERENCE, ROUND_TRIP, RESET)
OF_A_CAPTURE: Final = (COUNTS, STEADY, ERRORS, OVERFLOW, OVERRUN)

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
        if problems := incompatibilities(probed.described.description, plate):
            yield FITS.fault(first_of(problems).text)
        else:
            yield FITS.ok(f"the board measures what plate {plate.name} needs")
        yield _unit(identity.serial_number, plate.calibration.unit)
    yield _reference(probed.tick_rate)
    yield downgraded(_round_trip(probed), busy if probed.round_trips_s else "")  # late answers, not missing ones
    yield _reset(identity.reset_cause)


def _unit(present: str, unit: str | None) -> Finding:
    if unit is None:
        return UNIT.not_checked("the plate file does not name the board with which it was calibrated")
    if unit != present:
        return UNIT.fault(
            f"the plate file was calibrated with {unit}, {present} is connected",
            f"connect {unit}, or name the plate file of {present}",
        )
    return UNIT.ok(unit)


def _reference(rate: TickRate | None) -> Finding:
    if rate is None:
        return REFERENCE.not_checked("its ticks could not be timed")
    evidence = (
        f"ticks come {rate.deviation_ppm:+.0f} ppm off by this computer's clock, give or take "
        f"{rate.uncertainty_ppm:.0f}; at most {TOLERANCE_PPM:g} ppm are plausible"
    )
    if rate.plausible:
        return REFERENCE.ok(evidence, rate.deviation_ppm)
    return REFERENCE.fault(f"{evidence}: forces would be wrong by as much", "", rate.deviation_ppm)


def _round_trip(probed: ProbeResult) -> Finding:
    times_s = round_trip_s(probed)
    if times_s is None:
        return PINGS.fault("it identifies itself, and answers no ping")
    shortest_ms, median_ms = (time_s * 1e3 for time_s in times_s)
    limit = f"(limit {ROUND_TRIP.warning_above:g})"
    return ROUND_TRIP.judged(median_ms, f"{shortest_ms:.2f} ms at best, {median_ms:.2f} ms median {limit}")


def _reset(cause: int) -> Finding:
    if cause == ResetCause.BROWN_OUT:
        remedy = "check the board's power: a shorter cable, another port, a hub with a supply"
        return RESET.warning("its supply had broken down", remedy)
    if cause == ResetCause.WATCHDOG:
        return RESET.warning("its watchdog had restarted it", "update its firmware; report it to its maker")
    return RESET.ok(ResetCause(cause).name.lower().replace("_", " ") if cause in set(ResetCause) else f"cause {cause}")


def check_capture(capture: Capture) -> Iterator[Finding]:
    """Yield the findings on frames and bytes while the board counted."""
    if not capture.counted:
        yield from _nothing_came(capture)
        return
    yield COUNTS.ok(f"{capture.frames} frames in {capture.seconds:.1f} s")
    overruns = capture.after.host_overruns - capture.before.host_overruns
    yield downgraded(_errors(capture), "the driver lost bytes, which has the same effect" if overruns else "")
    steady, dropped = _steady(capture), _overflow(capture)
    explained = (dropped,) if capture.losses else (steady, dropped)
    if capture.busy and any(finding.outcome in (Outcome.FAULT, Outcome.NOT_CHECKED) for finding in explained):
        yield COMPUTER_BUSY.fault(capture.busy)
    yield downgraded(steady, "" if capture.losses else capture.busy)
    yield dropped
    yield OVERRUN.judged(overruns, f"{overruns} times, expected: none" if overruns else "none that it reports")


def _steady(capture: Capture) -> Finding:
    stops = (*capture.losses, *capture.interruptions)
    times = f"frames stopped {len(stops)} times in {capture.seconds:.1f} s"
    return STEADY.judged(len(stops), f"{times}: {stops[0]}" if stops else "frames came without interruption")


def _nothing_came(capture: Capture) -> Iterator[Finding]:
    rest = (STEADY, OVERFLOW, OVERRUN)
    counters = capture.after
    if capture.problems:
        codes = [problem.code for problem in capture.problems]
        check = REFERENCE if ReasonCode.WRONG_REFERENCE in codes else FITS
        yield check.fault(all_of(capture.problems).text, FITS.remedy)
        yield from not_checked((COUNTS, ERRORS, *rest), "the board does not serve this plate")
    elif counters.bytes_discarded > _GARBAGE_FAULT * max(counters.bytes_received, 1):
        yield _garbage(counters.bytes_discarded, counters.bytes_received, 0, 0)
        yield from not_checked((COUNTS, *rest), "too little arrives undamaged")
    elif refusals := counters.refusals.most_common(1):
        ((refused, count),) = refusals
        yield FRAMES.judged(count, f"{count} packets are refused ({refused.code}): {refused.text}")
        yield from not_checked((COUNTS, ERRORS, *rest), "no frame could be read")
    else:
        yield COUNTS.fault(f"it answers, and no frame came within {OPEN_S:g} s: {capture.link}")
        yield from not_checked((ERRORS, *rest), "no frame came")


def _overflow(capture: Capture) -> Finding:
    dropped = capture.after.lost.board_overflow - capture.before.lost.board_overflow
    rate_hz, least_hz = _all_frames(capture) / capture.seconds, _RATE_LEAST * capture.frame_rate_hz
    if dropped or rate_hz >= least_hz or capture.stopped:
        return overflow(dropped, _all_frames(capture), capture.busy)
    evidence = f"{rate_hz:.0f} of {capture.frame_rate_hz:g} frames per second arrive: the queue of the board fills"
    return downgraded(OVERFLOW.fault(evidence, "", Amount(rate_hz, least_hz, "Hz")), capture.busy)


def overflow(dropped: int, frames: int, busy: str = "") -> Finding:
    """Return the finding on dropped frames, of all frames; `busy` names this computer as the cause."""
    evidence = f"{dropped} of {frames} frames, expected: none"
    check = _OVERFLOW_OF_THIS_COMPUTER if busy else OVERFLOW
    amount = Amount(float(dropped), 0.0, "frames")
    return check.judged(dropped / frames, f"{evidence}; {busy}" if busy and dropped else evidence, amount=amount)


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
    return ERRORS.warning(evidence, "", hit / frames) if hit + discarded else ERRORS.ok(evidence, 0.0)


def _garbage(discarded: int, received: int, hit: int, frames: int) -> Finding:
    of_frames = f"{hit} of {frames} frames damaged or lost (limit {ERRORS_FAULT:g}), " if frames else "no whole frame, "
    evidence = f"{of_frames}{discarded} of {received} bytes are no packets (limit {_GARBAGE_FAULT:g})"
    return ERRORS.fault(evidence, "", hit / frames if frames else 1.0)


def _all_frames(capture: Capture) -> int:
    return max(1, capture.frames + capture.after.lost.total - capture.before.lost.total)
