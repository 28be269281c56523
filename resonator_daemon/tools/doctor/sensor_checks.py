"""Plate and counter: are all tones there and where they belong, how noisy, how steady, and is the plate at rest."""

import math
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import SKIN_SIGNALS
from resonator_daemon.measure.sensors.expected_tones import ExpectedTones
from resonator_daemon.tools.doctor.capture import Capture
from resonator_daemon.tools.doctor.finding import Amount, Area, Check, Finding, Outcome, graded, not_checked
from resonator_daemon.tools.doctor.plate_readings import PAIRS, known_mean

CHANNELS: Final = Check("sensor.channels", Area.SENSOR, "channels")
STAMPS: Final = Check("board.stamps", Area.SENSOR, "stamps from gate to gate")
AT_REST: Final = Check("sensor.at_rest", Area.SENSOR, "plate at rest")
TONES: Final = Check("sensor.tones", Area.SENSOR, "tones")
NOISE: Final = Check("sensor.noise", Area.SENSOR, "noise floor")
CROSS_TALK: Final = Check("sensor.cross_talk", Area.SENSOR, "cross-talk between channels")
DRIFT: Final = Check("sensor.drift", Area.SENSOR, "drift")
TEMPERATURE: Final = Check("board.temperature", Area.SENSOR, "temperature of the board")
CALIBRATION: Final = Check("sensor.calibration", Area.SENSOR, "calibration record")
OF_THE_PLATE: Final = (CHANNELS, AT_REST, TONES, NOISE, CROSS_TALK, DRIFT, TEMPERATURE)
CALIBRATE: Final = "resonatord calibrate, with known masses"

_COUNTED_SHARE: Final = 0.5  # of the readings, in which a tone that is alive is counted
_GATES_SHARE: Final = 0.9  # of the gates with a steady tone, of a board whose stamps do not run on
_NOISE_WARNING, _NOISE_FAULT = 3.0, 10.0  # over what counter and oscillator give
# What a counter takes for a signal is three times as strong as its noise; where they are equal, edges are lost.
_SCATTER_WARNING_RADIAN, _SCATTER_FAULT_RADIAN = 1.0 / 3.0, 1.0
_RESIDUAL_WARNING: Final = 1.0  # noise over the residuals of the calibration record
_ALIKE_WARNING, _ALIKE_FAULT = 2.0, 8.0  # times less than two channels of their own could differ
_DRIFT_PER_S: Final = 2e-8  # relative: that of 10 mK/s at a usual site, and 3 mN/s
_DRIFT_SIGMAS: Final = 6.0
_PRESSED_SHARE: Final = 0.05  # of the plate's largest force
_READINGS_MIN: Final = 5
_BOARD_KELVIN: Final = (233.0, 358.0)  # -40 to 85 degrees Celsius, for which parts are made
_STEP_KELVIN: Final = 5.0  # in some seconds: a sensor that is loose


def check_plate(capture: Capture, plate: Plate) -> Iterator[Finding]:
    """Yield the findings on the tones; `capture` is one in which frames came."""
    expected = capture.tones
    if len(capture.readings) < _READINGS_MIN:
        reason = f"{len(capture.readings)} readings of a tenth of a second, at least {_READINGS_MIN} are needed"
        yield from not_checked(OF_THE_PLATE, reason)
        return
    times_s = np.array([reading.time_s for reading in capture.readings])
    shift = np.array([reading.shift for reading in capture.readings])  # (r, t, 4)
    std = np.array([reading.std for reading in capture.readings])
    strange_hz = np.array([reading.strange_hz for reading in capture.readings])
    touched = np.array([reading.touched for reading in capture.readings]) | _moving(shift, plate)
    yield _at_rest(touched, shift, plate, expected)
    quiet = ~touched
    if np.count_nonzero(quiet) < _READINGS_MIN:
        yield from not_checked((CHANNELS, TONES, NOISE, CROSS_TALK, DRIFT), "the plate is touched")
    else:
        shift, std, strange_hz = shift[quiet], std[quiet], strange_hz[quiet]
        yield _channels(shift, strange_hz, np.mean([reading.gates_counted for reading in capture.readings], axis=0))
        yield _tones(shift, strange_hz, expected)
        scatter_radian = np.array([reading.scatter_radian for reading in capture.readings])[quiet]
        yield _worse(_noise(shift, std, plate, expected), _scatter(scatter_radian))
        yield _cross_talk(np.array([reading.pair_noise for reading in capture.readings])[quiet])
        yield _drift(times_s[quiet], shift, std)
    yield _temperature(capture.temperatures_kelvin)


def check_calibration(plate: Plate, expiry_note: str | None) -> Finding:
    """Return the finding on the plate's record; `expiry_note` is a sentence once it has expired, else None."""
    calibration = plate.calibration
    if calibration.id is None:
        return CALIBRATION.not_checked("the plate file has none")
    if expiry_note:
        return CALIBRATION.warning(expiry_note, CALIBRATE)
    return CALIBRATION.ok(f"{calibration.id}, of {calibration.date or 'an unknown day'}")


def _moving(shift: Floats, plate: Plate) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return in which readings one force site moves against all others: (r,)."""
    readings, tones, _ = shift.shape
    if tones < 3 or plate.signals == SKIN_SIGNALS:
        return np.zeros(readings, bool)
    force = _forces(shift - np.median(shift, axis=1, keepdims=True), plate)
    off: Floats = np.abs(force - np.median(force, axis=0))
    return np.asarray(off.max(axis=1) > 0.2 * _PRESSED_SHARE * plate.force_max_newton)


def _forces(shift: Floats, plate: Plate) -> Floats:
    """Return forces (r, t) by the plate file's sensitivities, NaN read as none."""
    force: Floats = np.nan_to_num(shift / plate.tones.sensitivity).mean(axis=-1)
    return force


def _at_rest(
    touched: np.ndarray[tuple[int], np.dtype[np.bool_]], shift: Floats, plate: Plate, expected: ExpectedTones
) -> Finding:
    remedy = "take everything off the plate and retry"
    readings = len(touched)
    if touched.all():
        return AT_REST.fault("a site is pressed all the time", remedy)
    if touched[0]:
        return AT_REST.warning(f"pressed at the start, and in {touched.sum()} of {readings} readings", remedy)
    if plate.signals != SKIN_SIGNALS and len(expected.names) > 2 and plate.calibration.id is not None:
        middle = np.median(np.nanmean(shift, axis=0), axis=0)
        force = _forces((np.nanmean(shift, axis=0) - middle)[None], plate)[0]
        worst = int(np.abs(force).argmax())
        limit_newton = _PRESSED_SHARE * plate.force_max_newton
        if abs(force[worst]) > limit_newton:
            return AT_REST.fault(
                f"{expected.names[worst]} reads {force[worst]:.2g} N, at most {limit_newton:.2g} N is rest",
                f"{remedy}; where it is bare, calibrate again",
                Amount(float(abs(force[worst])), limit_newton, "N"),
            )
    if touched.any():
        return AT_REST.warning(
            f"touched in {touched.sum()} of {readings} readings, which the checks below leave out",
            f"where nobody meant to touch it: {remedy}",
        )
    return AT_REST.ok("nothing touches it")


def _channels_named(channels: NDArray[np.intp]) -> str:
    return f"channel{'s' * (len(channels) > 1)} {', '.join(map(str, channels))}"


def _channels(shift: Floats, strange_hz: Floats, gates_counted: Floats) -> Finding:
    """Judge each channel by the share of all tones that it counts, wherever they are."""
    counted = np.isfinite(shift).mean(axis=(0, 1)) + np.isfinite(strange_hz).mean(axis=0)
    dead = np.flatnonzero(counted < _COUNTED_SHARE)
    least = f"a channel counts as alive that counts {100 * _COUNTED_SHARE:.0f} % of its tones"
    if len(dead) and (gates_counted[dead] >= _GATES_SHARE).all():
        return STAMPS.fault(
            f"{_channels_named(dead)}: {100 * gates_counted[dead].min():.0f} % of the gates count a tone, and no gate "
            "continues the one before",
            "correct the firmware: the edge index and the ticks of stamps run on from gate to gate (PROTOCOL.md)",
            Amount(float(counted.min()), _COUNTED_SHARE),
        )
    if len(dead):
        return CHANNELS.fault(
            f"{_channels_named(dead)} of 0 to {CHANNEL_COUNT - 1}: too few tones counted; {least}",
            "check the transducer, its plug and its amplifier; if all channels are dead, the drive of the plate",
            Amount(float(counted.min()), _COUNTED_SHARE),
        )
    return CHANNELS.ok(f"all {CHANNEL_COUNT} count their tones", Amount(float(counted.min()), _COUNTED_SHARE))


def _tones(shift: Floats, strange_hz: Floats, expected: ExpectedTones) -> Finding:
    alive = np.isfinite(shift).mean(axis=(0, 1)) >= _COUNTED_SHARE  # dead channels have a finding of their own
    counted = np.isfinite(shift).mean(axis=0)[:, alive]  # (t, channels that are alive)
    uncounted = np.flatnonzero((counted < _COUNTED_SHARE).any(axis=1))
    off = np.nanmax(np.abs(known_mean(shift, axis=0)), axis=1, initial=0.0)  # (t,)
    outside = np.flatnonzero(off > expected.band)
    if np.isfinite(strange_hz).any():
        frequency_hz = float(np.nanmean(strange_hz))
        nearest_hz = float(expected.f0_hz.mean())
        return TONES.fault(
            f"{frequency_hz / 1e6:.6f} MHz is counted, neither {expected.names[0]} ({nearest_hz / 1e6:.6f} MHz) "
            "nor a site of the plate file",
            "name the plate file of this plate, or calibrate it again",
            Amount(frequency_hz, nearest_hz, "Hz"),
        )
    if len(outside):
        worst = int(outside[np.argmax(off[outside] / expected.band[outside])])
        return TONES.fault(
            f"{len(outside)} of {len(off)} out of band, the worst is {expected.names[worst]}: "
            f"{1e6 * off[worst]:.1f} ppm off, at most {1e6 * expected.band[worst]:.1f} ppm",
            "name the plate file of this plate; a single tone that is off is a broken site",
            Amount(1e6 * float(off[worst]), 1e6 * float(expected.band[worst]), "ppm"),
        )
    if len(uncounted):
        names = ", ".join(expected.names[tone] for tone in uncounted[:5])
        return TONES.fault(
            f"{len(uncounted)} of {len(off)} are not counted by every channel that is alive: {names}",
            "these sites are broken, or another tone covers theirs",
            Amount(float(len(uncounted)), 0.0, "tones"),
        )
    if not alive.any():
        return TONES.not_checked("no channel detects them")
    worst = int(np.argmax(off / expected.band))
    return TONES.ok(
        f"{'the only one is' if len(off) == 1 else f'all {len(off)} are'} in band: at most {1e6 * off[worst]:.1f} ppm "
        f"off (limit {1e6 * expected.band[worst]:.1f})",
        Amount(1e6 * float(off[worst]), 1e6 * float(expected.band[worst]), "ppm"),
    )


def _noise(shift: Floats, std: Floats, plate: Plate, expected: ExpectedTones) -> Finding:
    """Compare how readings bend with what counter and oscillator give, tone by tone; drift hardly bends them."""
    steps = np.diff(shift, 2, axis=0)
    usable = np.isfinite(steps)
    count = usable.sum(axis=0)
    if not (count > 1).any():
        return NOISE.not_checked("no tone is counted for some readings in a row")
    expected = np.where(usable, std[2:] ** 2 + 4.0 * std[1:-1] ** 2 + std[:-2] ** 2, 0.0).sum(axis=0)
    seen = np.where(usable, steps**2, 0.0).sum(axis=0)  # (t, 4)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.sqrt(seen / expected)
    by_channel = np.nanmedian(ratio, axis=0) if len(ratio) > 1 else ratio[0]
    channel = int(np.nanargmax(by_channel))
    worst = float(by_channel[channel])
    evidence = f"{worst:.1f} times what counter and oscillator give, on channel {channel} (limit {_NOISE_WARNING:g})"
    outcome = graded(worst, _NOISE_WARNING, _NOISE_FAULT)
    residuals = plate.calibration.residuals
    if residuals and plate.signals != SKIN_SIGNALS:
        rms = np.sqrt(seen.sum() / (6 * count.sum()))
        newton = float(rms / np.abs(plate.tones.sensitivity).mean())
        evidence += f"; {1e3 * newton:.2g} mN, the calibration record left {1e3 * max(residuals):.2g} mN"
        if newton > _RESIDUAL_WARNING * max(residuals) and outcome is Outcome.OK:
            outcome = Outcome.WARNING
    remedy = "look for vibration, a loose plate or plug, a supply that hums, a neighbouring motor"
    return NOISE.judged(outcome, evidence, remedy, Amount(worst, _NOISE_WARNING, "times"))


def _scatter(scatter_radian: Floats) -> Finding:
    """Compare the noise of single edges, which readings average out, with what a usable signal leaves; (r, 4)."""
    if not np.isfinite(scatter_radian).any():
        return NOISE.not_checked("no edges are counted")
    by_channel = known_mean(scatter_radian, axis=0)
    channel = int(np.nanargmax(by_channel))
    worst = float(by_channel[channel])
    return NOISE.judged(
        graded(worst, _SCATTER_WARNING_RADIAN, _SCATTER_FAULT_RADIAN),
        f"edges scatter by {worst:.2f} rad of the tone on channel {channel} (limit {_SCATTER_WARNING_RADIAN:.2f})",
        "the signal drowns: look at transducer, amplifier, shield and supply of that channel",
        Amount(worst, _SCATTER_WARNING_RADIAN, "rad"),
    )


def _worse(one: Finding, other: Finding) -> Finding:
    graver = other.outcome is Outcome.FAULT or (other.outcome is Outcome.WARNING and one.outcome is not Outcome.FAULT)
    return other if graver else one


def _cross_talk(pair_noise: Floats) -> Finding:
    """Two channels that count by themselves differ by their noise; one that receives the other's tone does not."""
    if not np.isfinite(pair_noise).any():
        return CROSS_TALK.not_checked("no two channels detect the same tone")
    mean = known_mean(pair_noise, axis=0)
    if np.nanmax(mean) < 1.0 / _ALIKE_WARNING:
        return CROSS_TALK.not_checked(
            "all channels differ by less than the noise that the counter states: they count a signal without jitter, "
            "as of a generator"
        )
    pair = int(np.nanargmin(mean))
    alike = 1.0 / max(float(mean[pair]), 1e-6)
    first, second = PAIRS[pair]
    evidence = (
        f"channels {first} and {second} are the most alike: their difference has {100 / max(alike, 1.0):.0f} % "
        f"of the variance that noise of their own would give (limit {100 / _ALIKE_WARNING:.0f} %)"
    )
    return CROSS_TALK.judged(
        graded(alike, _ALIKE_WARNING, _ALIKE_FAULT),
        evidence,
        "one of them receives the other's signal: check plugs and shields of both transducers",
        Amount(alike, _ALIKE_WARNING, "times"),
    )


def _drift(times_s: Floats, shift: Floats, std: Floats) -> Finding:
    """Fit a line to each tone's mean over the channels, and judge the fastest that is no noise."""
    values = known_mean(shift, axis=2)  # (r, t)
    complete = np.isfinite(values).all(axis=0)
    if not complete.any():
        return DRIFT.not_checked("no tone is counted all the time")
    lever = times_s - times_s.mean()
    line = lever / (lever @ lever)
    slope = line @ values[:, complete]
    rest = values[:, complete] - values[:, complete].mean(axis=0) - np.outer(lever, slope)
    slope_std = np.sqrt((rest**2).sum(axis=0) / max(1, len(lever) - 2) * (line @ line))
    sure = np.maximum(np.abs(slope) - _DRIFT_SIGMAS * slope_std, 0.0)
    worst = int(sure.argmax())
    evidence = (
        f"{1e9 * abs(slope[worst]):.1f} ppb/s, give or take {1e9 * slope_std[worst]:.1f} "
        f"(limit {1e9 * _DRIFT_PER_S:.0f} beyond that)"
    )
    return DRIFT.judged(
        graded(float(sure[worst]), _DRIFT_PER_S, math.inf),
        evidence,
        "let plate and board warm up, keep draughts and hands away, and retry",
        Amount(1e9 * float(sure[worst]), 1e9 * _DRIFT_PER_S, "ppb/s"),
    )


def _temperature(kelvin: list[float]) -> Finding:
    if not kelvin:
        return TEMPERATURE.not_checked("the board does not report it, or has not reported it in this time")
    low, high = min(kelvin), max(kelvin)
    evidence = f"{low:.1f} to {high:.1f} K"
    remedy = "cool or warm the board; a value that no board can have means a broken thermometer"
    if not (_BOARD_KELVIN[0] <= low and high <= _BOARD_KELVIN[1]):
        limits = f"{_BOARD_KELVIN[0]:g} to {_BOARD_KELVIN[1]:g} K are plausible"
        beyond = low if low < _BOARD_KELVIN[0] else high
        limit = _BOARD_KELVIN[0] if low < _BOARD_KELVIN[0] else _BOARD_KELVIN[1]
        return TEMPERATURE.fault(f"{evidence}, {limits}", remedy, Amount(beyond, limit, "K"))
    if high - low > _STEP_KELVIN:
        return TEMPERATURE.warning(
            f"{evidence} within seconds, at most {_STEP_KELVIN:g} K is plausible",
            remedy,
            Amount(high - low, _STEP_KELVIN, "K"),
        )
    return TEMPERATURE.ok(evidence, Amount(high, _BOARD_KELVIN[1], "K"))
