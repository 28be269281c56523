"""Sensor whose counter counts all tones of force sites at once."""

import math
from collections import deque
from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist, squareform

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.session.frames import ChannelisedFrame, Frame
from resonator_daemon.estimate.forces.force_sites import ForceSites, ForceTones, SiteShifts
from resonator_daemon.estimate.forces.plate_drift import OFF_SIGMAS, DriftReading, PlateDrift
from resonator_daemon.estimate.forces.readings import (
    ONSET_NEWTON,
    Compensation,
    ForceReading,
    SensorStatus,
    Touch,
    touch_of,
)
from resonator_daemon.estimate.forces.site_errors import PressedSites
from resonator_daemon.estimate.forces.site_identification import SiteForce, overload_reason
from resonator_daemon.estimate.forces.spread import TOUCHES_MAX, SpreadFit, Touches
from resonator_daemon.estimate.tones.frequency_estimators import oscillator_std
from resonator_daemon.estimate.tones.tone_detector import MultitoneDetector, ToneDetector
from resonator_daemon.estimate.tones.tone_merging import SIGMA_HZ, merge_tones
from resonator_daemon.measure.sensors.expected_tones import ExpectedTones, force_tones
from resonator_daemon.measure.sensors.force_sensor import ForceProcessing, ForceSensor
from resonator_daemon.measure.sensors.output import NO_TONE
from resonator_daemon.measure.sensors.plate_sites import force_sites

OFFSET_STD: Final = 2e-7  # of a site's f0 since calibration, relative: the ageing of weeks
LOCAL_KELVIN_STD: Final = 0.01  # of a site's own thermometer
KNOWN_KELVIN: Final = 2.0  # a temperature that is known worse is not compared with the calibration's range
SHARE_ERROR: Final = 0.003  # of a touch, by which a site's share differs from the law of the cover
UNLAWFUL_SHARE_ERROR: Final = 0.05  # where the sites' forces do not follow that law
UNEXPLAINED_MAX: Final = 0.2  # of the squares of the sites' forces: with more, no touch can be named
SEARCH_EVERY: Final = 100  # readings that no touches explain between two searches for more, which take 0.1 s
REACH_PITCHES: Final = 1.0  # a touch that moves less between two readings is the same touch
CORNERS: Final = 4


class _Frame(NamedTuple):
    phase_turn32: NDArray[np.integer]
    offset_hz16: NDArray[np.integer]
    sigma_hz: Floats
    known: NDArray[np.bool_]


class MultitoneProcessing(ForceProcessing):
    """Channelised frames of force sites in, readings out."""

    def __init__(
        self,
        sites: ForceSites,
        tones: ForceTones,
        *,
        reference_hz: float,
        gate_s: float,
        window_frames: int,
        step_frames: int,
        spread_width_m: float | None = None,
    ) -> None:
        """Initialise with a plate's sites and tones; without a width of the spread, each site is touched by itself."""
        reach_m = 0.0 if spread_width_m is None else REACH_PITCHES * _pitch_m(sites.positions_m)
        super().__init__(sites, reference_hz=reference_hz, gate_s=gate_s, reach_m=reach_m)
        self._tones = tones
        self._step_frames = step_frames
        self._frames: deque[_Frame] = deque(maxlen=window_frames)
        self._drift = PlateDrift(
            sites.warmth.coefficients.T,
            coefficient_std=sites.warmth.coefficient_std,
            offset_std=OFFSET_STD,
            local_kelvin_std=LOCAL_KELVIN_STD,
        )
        self._spread = self._near = None
        if spread_width_m is not None:
            self._spread, self._near = (
                SpreadFit(
                    sites.positions_m,
                    spread_width_m,
                    model_error=sites.model_error,
                    share_error=share_error,
                    outline_m=sites.outline_m,
                )
                for share_error in (SHARE_ERROR, UNLAWFUL_SHARE_ERROR)
            )
        self._reach_m = reach_m
        self._touch_places_m: list[tuple[float, float]] = []  # places of the touches of the last reading
        self._drifted: DriftReading | None = None  # these are of the last reading
        self._shifts: SiteShifts | None = None
        self._found: Touches | None = None
        self._rejections = 0
        self._touched = False

    def _reset(self) -> None:
        self._frames.clear()
        self._drift.reset()
        self._drifted = self._shifts = self._found = None
        self._touch_places_m = []
        self._rejections = 0
        self._touched = False

    def tare(self) -> str | None:
        if self._shifts is None:
            return "no reading yet"
        if self._touched:
            return "sites are touched"
        self._drift.tare(self._shifts.shift, self._shifts.variance)
        return None

    def _measure_over(self, window_frames: int, step_frames: int) -> None:
        self._step_frames = step_frames
        self._frames = deque(self._frames, maxlen=window_frames)

    @property
    def compensation(self) -> Compensation:
        unknown = Compensation((math.nan,) * CORNERS, math.nan, "unknown", math.nan, math.nan, self._response)
        return self._compensation(self._drifted) if self._drifted is not None else unknown

    def process(self, frames: Sequence[Frame]) -> list[ForceReading]:
        readings = [
            self.push(
                frame.index, frame.board_ticks, frame.phase_turn32, frame.offset_hz16, frame.sigma_code, frame.known
            )
            for frame in frames
            if isinstance(frame, ChannelisedFrame)
        ]
        return [reading for reading in readings if reading is not None]

    def push(
        self,
        sequence: int,
        board_ticks: int,
        phase_turn32: NDArray[np.integer],
        offset_hz16: NDArray[np.integer],
        sigma_code: NDArray[np.uint8],
        known: NDArray[np.bool_],
    ) -> ForceReading | None:
        """Process one frame, arrays (4, t) in the wire's units; return a reading at every `step_frames`-th, else None.

        `sequence` and `board_ticks` are unwrapped; frames that are missing between two calls restart the window.
        """
        if self._last is not None and sequence != self._last[0] + 1:
            self._frames.clear()
        self._last = sequence, board_ticks
        self._frames.append(_Frame(phase_turn32, offset_hz16, SIGMA_HZ[sigma_code], known))
        return self._read(sequence, board_ticks) if (sequence + 1) % self._step_frames == 0 else None

    def _read(self, sequence: int, board_ticks: int) -> ForceReading:
        window_s = len(self._frames) * self._gate_s
        phase, offset, sigma_hz, known = (np.array(part) for part in zip(*self._frames, strict=True))
        merged = merge_tones(phase, offset, sigma_hz, known, self._gate_s)
        shifts = self._tones.shifts(merged.offset_hz, merged.sigma_hz)
        shifts = self._shifts = shifts._replace(variance=shifts.variance + oscillator_std(window_s) ** 2)
        detected = np.isfinite(shifts.shift)
        status, reason = _status(detected, np.sqrt(shifts.variance) / np.abs(shifts.sensitivity))
        last_ticks = board_ticks if self._evaluated_ticks is None else self._evaluated_ticks
        self._evaluated_ticks = board_ticks
        time_s, elapsed_s = board_ticks / self._reference_hz, max(board_ticks - last_ticks, 0) / self._reference_hz

        if self._drifted is None:
            self._errors.rest(time_s)
        before = self._drifted or self._drift.update(shifts.shift, shifts.variance, elapsed_s, shifts.kelvin)
        forces = self._forces(shifts, before, time_s)
        load, pressed = np.zeros(len(detected)), np.zeros(len(detected), dtype=bool)
        if self._spread is not None:
            rejected = self._found is not None and self._found.status == "rejected"
            self._rejections = self._rejections + 1 if rejected else 0
            found = self._found = self._fit(self._spread, forces, self._found)
            # What is too light for a contact counts as drift: a shock of temperature looks like that, site by site.
            load = self._spread.loads(found, ONSET_NEWTON)
            pressed = load >= ONSET_NEWTON
            if found.status == "rejected" and bool((np.abs(forces.force_newton) >= ONSET_NEWTON).any()):
                # Far sites do not follow the law, or there is more: only the sites near the touches are used.
                status, reason = "rejected", found.reason
                load, pressed = np.zeros(len(detected)), np.ones(len(detected), dtype=bool)
                if len(found.force_newton) < TOUCHES_MAX:
                    found = self._fit(self._near, forces, found)
                    if found.status == "ok" or found.unexplained < UNEXPLAINED_MAX:
                        status = "possibly_more"
            touches = self._touches_of(found, forces, status) if status in ("ok", "possibly_more") else []
        drift = before
        if self._drifted is not None:
            drift = self._follow(shifts, before, forces, load, pressed, elapsed_s)
        if self._spread is None:
            positions_m, covariance_m2 = self._positions_m, self._covariance_m2
            touches = [
                touch_of(self._site_force(forces, site), positions_m[site], covariance_m2[site])
                for site in np.flatnonzero(drift.in_contact)
            ]
        if any(touch.status == "overload" for touch in touches):
            status, reason = "overload", overload_reason(self._sites.force_max_newton)
        self._drifted = drift
        complete = status in ("ok", "possibly_more", "overload")
        touches = self._confirmed(touches)
        events = self._tracker.update(board_ticks, touches, complete=complete, status=status, reason=reason)
        self._touched = bool(self._tracker.contacts) or bool(pressed.any())
        return ForceReading(
            sequence,
            board_ticks,
            window_s,
            True,
            status,
            reason,
            tuple(self._site_force(forces, site) for site in np.flatnonzero(drift.in_contact)),
            self._tracker.contacts,
            events,
            self._compensation(drift),
        )

    def _confirmed(self, touches: list[Touch]) -> list[Touch]:
        """Return the touches near a contact or a touch of the reading before: a fit to a change is no touch."""
        before = [*self._touch_places_m, *(contact.touch.position_m for contact in self._tracker.contacts)]
        self._touch_places_m = [touch.position_m for touch in touches]
        return [t for t in touches if any(math.dist(t.position_m, place) <= self._reach_m for place in before)]

    def _forces(self, shifts: SiteShifts, drift: DriftReading, time_s: float) -> PressedSites:
        """Return the force of every site, (m,), NaN where no channel counts it.

        Untouched sites are followed, too: what a press leaves in them must not pass for a touch.
        """
        per_shift = 1.0 / np.abs(shifts.sensitivity)
        felt = (shifts.shift - drift.expected_shift) / shifts.sensitivity
        forces = self._errors.press(
            np.arange(len(felt)),
            felt,
            np.sqrt(shifts.variance) * per_shift,
            drift.expected_std * per_shift,
            per_shift,
            time_s,
            drift.in_contact,
        )
        low, high = self._sites.valid_kelvin
        theta = drift.theta_kelvin if drift.theta_std_kelvin < KNOWN_KELVIN else math.nan
        kelvin = np.where(np.isnan(shifts.kelvin), theta, shifts.kelvin)
        return forces._replace(calibrated=forces.calibrated & ~((kelvin < low) | (kelvin > high)))

    def _fit(self, spread: SpreadFit | None, forces: PressedSites, before: Touches | None) -> Touches:
        assert spread is not None  # noqa: S101 - for the type checker
        return spread.fit(
            forces.force_newton,
            forces.noise_newton**2,
            forces.systematic_newton**2,
            before,
            # The search is repeated with exponential back-off; a change starts it at once.
            search=self._rejections.bit_count() <= 1 or self._rejections % SEARCH_EVERY == 0,
        )

    def _follow(
        self,
        shifts: SiteShifts,
        before: DriftReading,
        forces: PressedSites,
        load: Floats,
        pressed: NDArray[np.bool_],
        elapsed_s: float,
    ) -> DriftReading:
        """Update the drift with what the touches leave over: their load on far sites must not pass for drift."""
        left = before.expected_shift + shifts.sensitivity * (forces.force_newton - load)
        own, shared = self._sites.model_error * load, SHARE_ERROR * load.max()
        error_newton2 = forces.noise_newton**2 + own**2 + shared**2
        # No press makes a site feel less than nothing.
        free = forces.force_newton < -OFF_SIGMAS * np.hypot(forces.noise_newton, forces.systematic_newton)
        variance = error_newton2 * shifts.sensitivity**2
        return self._drift.update(left, variance, elapsed_s, shifts.kelvin, pressed & ~free, free)

    def _touches_of(self, found: Touches, forces: PressedSites, status: SensorStatus) -> list[Touch]:
        # A poor fit widens the errors, but not the noise.
        widening = max(found.chi2 / found.freedom, 1.0) if found.freedom else 1.0
        touches = []
        for position_m, newton, covariance, noise in zip(
            found.position_m, found.force_newton.tolist(), found.covariance, found.noise_newton.tolist(), strict=True
        ):
            nearest = int(np.hypot(*(self._sites.positions_m - position_m).T).argmin())
            other = math.sqrt(max(widening * float(covariance[2, 2]) - noise**2, 0.0))
            x, y = position_m.tolist()
            over = newton > self._sites.force_max_newton
            unmodelled = max(
                float(forces.unmodelled_newton[nearest]), float(self._errors.unmodelled_newton(np.array(newton)))
            )
            touches.append(
                Touch(
                    nearest,
                    (x, y),
                    widening * covariance[:2, :2],
                    math.nan if over else newton,
                    math.nan if over else noise,
                    math.nan if over else math.hypot(other, self._sites.sensitivity_std * newton, unmodelled),
                    _word(over=over, calibrated=bool(forces.calibrated[nearest]), alone=status == "ok"),
                    at_least_newton=self._sites.force_max_newton if over else None,
                )
            )
        return touches

    def _site_force(self, forces: PressedSites, site: np.intp) -> SiteForce:
        newton, largest = float(forces.force_newton[site]), self._sites.force_max_newton
        own = math.hypot(self._sites.model_error * newton, float(forces.unmodelled_newton[site]))
        over = newton > largest
        if math.isnan(newton):
            return SiteForce(int(site), math.nan, math.nan, math.nan, "no_signal")
        return SiteForce(
            int(site),
            math.nan if over else newton,
            math.nan if over else float(forces.noise_newton[site]),
            math.nan if over else math.hypot(float(forces.systematic_newton[site]), own),
            _word(over=over, calibrated=bool(forces.calibrated[site])),
            largest if over else None,
        )

    def _compensation(self, drift: DriftReading) -> Compensation:
        return Compensation(
            (drift.reference_shift,) * CORNERS,
            math.nan,
            "followed" if drift.held_s == 0.0 else "held",
            drift.theta_kelvin,
            drift.theta_std_kelvin,
            self._response,
        )


def _status(detected: NDArray[np.bool_], noise_newton: Floats) -> tuple[SensorStatus, Reason | None]:
    silent = int(np.count_nonzero(~detected))
    if silent == len(detected):
        return "no_signal", NO_TONE
    if (usual := float(np.median(noise_newton[detected]))) > ONSET_NEWTON:
        return "no_signal", Reason(ReasonCode.TOO_NOISY, f"noise of {usual:.2g} N hides touches")
    if silent:
        return "ok", Reason(ReasonCode.SITES_SILENT, f"{silent} of {len(detected)} sites are not detected")
    return "ok", None


def _word(
    *, over: bool, calibrated: bool, alone: bool = True
) -> Literal["ok", "overload", "uncalibrated", "possibly_more"]:
    if over:
        return "overload"
    if not calibrated:
        return "uncalibrated"
    return "ok" if alone else "possibly_more"


def _pitch_m(positions_m: Floats) -> float:
    """Median distance of a site to its nearest neighbour; 0 for a site alone."""
    if len(positions_m) < 2:
        return 0.0
    apart = squareform(pdist(positions_m))
    np.fill_diagonal(apart, np.inf)
    return float(np.median(apart.min(axis=1)))


class MultitoneSensor(ForceSensor):
    """Force sites, each with a tone that is always counted."""

    replaces = "multitone"

    @property
    def expected_tones(self) -> ExpectedTones:
        return force_tones(self.plate)

    def tone_detector(self, frames: int, oscillator_hz: Floats) -> ToneDetector:
        return MultitoneDetector(frames, 1 / self.plate.counter.frame_rate_hz, oscillator_hz)

    def make_processing(self, oscillator_hz: Floats) -> MultitoneProcessing:
        plate, tones = self.plate, self.plate.tones
        return MultitoneProcessing(
            force_sites(plate),
            ForceTones(tones.f0_hz, tones.sensitivity, oscillator_hz, tones.site_index, tones.signal_index),
            reference_hz=plate.counter.reference_hz,
            gate_s=1 / plate.counter.frame_rate_hz,
            window_frames=self.window_frames,
            step_frames=self.step_frames,
            spread_width_m=plate.spread_width_m,
        )
