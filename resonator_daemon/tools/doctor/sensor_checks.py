"""Plate and counter: are all tones there and where they belong, how noisy, how steady, and is the plate at rest."""

from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.layouts import CHANNEL_COUNT
from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.plate import Plate
from resonator_daemon.base.plate_tables import SKIN_SIGNALS
from resonator_daemon.measure.sensors.expected_tones import ExpectedTones
from resonator_daemon.tools.doctor.capture import Capture, PlateReading
from resonator_daemon.tools.doctor.finding import Amount, Finding, Outcome, make_check, not_checked

CHANNELS: Final = make_check("sensor.channels")
STAMPS: Final = make_check("board.stamps")
AT_REST: Final = make_check("sensor.at_rest")
TONES: Final = make_check("sensor.tones")
# over what counter and oscillator give
NOISE: Final = make_check("sensor.noise", "times", warning_above=3.0, fault_above=10.0)
# What a counter takes for a signal is three times as strong as its noise; where they are equal, edges are lost.
_FIX_SCATTER: Final = "the signal drowns: look at transducer, amplifier, shield and supply of that channel"
_SCATTER: Final = replace(NOISE, remedy=_FIX_SCATTER, unit="rad", warning_above=1.0 / 3.0, fault_above=1.0)
CALIBRATION: Final = make_check("sensor.calibration")
_OF_TONES: Final = (CHANNELS, TONES, NOISE)
OF_THE_PLATE: Final = (AT_REST, *_OF_TONES)

_COUNTED_SHARE: Final = 0.5  # of the readings, in which a tone that is alive is counted
_GATES_SHARE: Final = 0.9  # of the gates with a steady tone, of a board whose stamps do not run on
_PRESSED_SHARE: Final = 0.05  # of the plate's largest force
_READINGS_MIN: Final = 5


def check_plate(capture: Capture, plate: Plate) -> Iterator[Finding]:
    """Yield the findings on the tones; `capture` is one in which frames came."""
    expected = capture.tones
    if len(capture.readings) < _READINGS_MIN:
        reason = f"{len(capture.readings)} readings of a tenth of a second, at least {_READINGS_MIN} are needed"
        yield from not_checked(OF_THE_PLATE, reason)
        return
    every = {
        field.name: np.array([getattr(reading, field.name) for reading in capture.readings])
        for field in fields(PlateReading)
    }
    touched = every["touched"] | _moving(every["shift"], plate)
    yield _at_rest(touched, every["shift"], plate, expected)
    if np.count_nonzero(~touched) < _READINGS_MIN:
        yield from not_checked(_OF_TONES, "the plate is touched")
    else:
        quiet = {name: values[~touched] for name, values in every.items()}
        shift, std = quiet["shift"], quiet["std"]  # (r, t, 4)
        yield _channels(shift, quiet["strange_hz"], every["gates_counted"].mean(axis=0))
        yield _tones(shift, quiet["strange_hz"], expected)
        noise, scatter = _noise(shift, std), _scatter(quiet["scatter_radian"])
        yield scatter if list(Outcome).index(scatter.outcome) > list(Outcome).index(noise.outcome) else noise


def check_calibration(plate: Plate, expiry_note: str | None) -> Finding:
    """Return the finding on the plate's record; `expiry_note` is a sentence once it has expired, else None."""
    calibration = plate.calibration
    if calibration.id is None:
        return CALIBRATION.not_checked("the plate file has none")
    if expiry_note:
        return CALIBRATION.warning(expiry_note)
    return CALIBRATION.ok(f"{calibration.id}, of {calibration.date or 'an unknown day'}")


def _moving(shift: Floats, plate: Plate) -> NDArray[np.bool_]:
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


def _at_rest(touched: NDArray[np.bool_], shift: Floats, plate: Plate, expected: ExpectedTones) -> Finding:
    if touched.all():
        return AT_REST.fault("a site is pressed all the time")
    in_readings = f"in {touched.sum()} of {len(touched)} readings"
    if touched[0]:
        return AT_REST.warning(f"pressed at the start, and {in_readings}")
    if plate.signals != SKIN_SIGNALS and len(expected.names) > 2 and plate.calibration.id is not None:
        middle = np.median(np.nanmean(shift, axis=0), axis=0)
        force = _forces((np.nanmean(shift, axis=0) - middle)[None], plate)[0]
        worst = int(np.abs(force).argmax())
        limit_newton = _PRESSED_SHARE * plate.force_max_newton
        if abs(force[worst]) > limit_newton:
            return AT_REST.fault(
                f"{expected.names[worst]} reads {force[worst]:.2g} N, at most {limit_newton:.2g} N is rest",
                f"{AT_REST.remedy}; where it is bare, calibrate again",
                Amount(float(abs(force[worst])), limit_newton, "N"),
            )
    if touched.any():
        evidence = f"touched {in_readings}, which the checks below leave out"
        return AT_REST.warning(evidence, f"where nobody meant to touch it: {AT_REST.remedy}")
    return AT_REST.ok("nothing touches it")


def _channels(shift: Floats, strange_hz: Floats, gates_counted: Floats) -> Finding:
    """Judge each channel by the share of all tones that it counts, wherever they are."""
    counted = np.isfinite(shift).mean(axis=(0, 1)) + np.isfinite(strange_hz).mean(axis=0)
    dead = np.flatnonzero(counted < _COUNTED_SHARE)
    amount = Amount(float(counted.min()), _COUNTED_SHARE)
    if not len(dead):
        return CHANNELS.ok(f"all {CHANNEL_COUNT} count their tones", amount)
    named = f"channel{'s' * (len(dead) > 1)} {', '.join(map(str, dead))}"
    if (gates_counted[dead] >= _GATES_SHARE).all():
        share = f"{100 * gates_counted[dead].min():.0f} % of the gates count a tone"
        return STAMPS.fault(f"{named}: {share}, and no gate continues the one before", "", amount)
    least = f"a channel counts as alive that counts {100 * _COUNTED_SHARE:.0f} % of its tones"
    return CHANNELS.fault(f"{named} of 0 to {CHANNEL_COUNT - 1}: too few tones counted; {least}", "", amount)


def _tones(shift: Floats, strange_hz: Floats, expected: ExpectedTones) -> Finding:
    alive = np.isfinite(shift).mean(axis=(0, 1)) >= _COUNTED_SHARE  # dead channels have a finding of their own
    counted = np.isfinite(shift).mean(axis=0)[:, alive]  # (t, channels that are alive)
    uncounted = np.flatnonzero((counted < _COUNTED_SHARE).any(axis=1))
    off = np.nanmax(np.abs(_known_mean(shift, axis=0)), axis=1, initial=0.0)  # (t,)
    outside = np.flatnonzero(off > expected.band)
    worst = int(np.argmax(off / expected.band))
    off_ppm, band_ppm = 1e6 * float(off[worst]), 1e6 * float(expected.band[worst])
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
        return TONES.fault(
            f"{len(outside)} of {len(off)} out of band, the worst is {expected.names[worst]}: "
            f"{off_ppm:.1f} ppm off, at most {band_ppm:.1f} ppm",
            "name the plate file of this plate; a single tone that is off is a broken site",
            Amount(off_ppm, band_ppm, "ppm"),
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
    which = "the only one is" if len(off) == 1 else f"all {len(off)} are"
    evidence = f"{which} in band: at most {off_ppm:.1f} ppm off (limit {band_ppm:.1f})"
    return TONES.ok(evidence, Amount(off_ppm, band_ppm, "ppm"))


def _noise(shift: Floats, std: Floats) -> Finding:
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
    limit = f"(limit {NOISE.warning_above:g})"
    evidence = f"{worst:.1f} times what counter and oscillator give, on channel {channel} {limit}"
    return NOISE.judged(worst, evidence)


def _scatter(scatter_radian: Floats) -> Finding:
    """Compare the noise of single edges, which readings average out, with what a usable signal leaves; (r, 4)."""
    if not np.isfinite(scatter_radian).any():
        return _SCATTER.not_checked("no edges are counted")
    by_channel = _known_mean(scatter_radian, axis=0)
    channel = int(np.nanargmax(by_channel))
    worst = float(by_channel[channel])
    limit = f"(limit {_SCATTER.warning_above:.2f})"
    return _SCATTER.judged(worst, f"edges scatter by {worst:.2f} rad of the tone on channel {channel} {limit}")


def _known_mean(values: Floats, axis: int) -> Floats:
    """Return the mean of the finite values along an axis, NaN where there is none."""
    mean: Floats = np.ma.masked_invalid(values).mean(axis=axis).filled(np.nan)
    return mean
