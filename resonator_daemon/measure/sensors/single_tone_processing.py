"""Counts of one captured tone per corner to forces, sites and contacts: the stages of measurement in their order."""

import math
from collections import Counter
from collections.abc import Sequence
from operator import attrgetter
from typing import Final, Literal

import numpy as np

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.board.session.frames import Frame, SingleToneFrame
from resonator_daemon.estimate.forces.baseline import CommonMode, OscillatorNoise
from resonator_daemon.estimate.forces.force_sites import ForceSites, hidden_fraction
from resonator_daemon.estimate.forces.readings import (
    Compensation,
    CornerTone,
    ForceReading,
    SensorStatus,
    Touch,
    touch_of,
)
from resonator_daemon.estimate.forces.site_identification import Match, Matcher, OverloadLatch, SiteForce
from resonator_daemon.estimate.tones.frequency_estimators import counter_std, oscillator_std
from resonator_daemon.estimate.tones.record_checks import CAPTURE_SWITCH, FAULTS_IN_WORDS
from resonator_daemon.estimate.tones.tone_count import NO_TONE, ToneCount, count_tone
from resonator_daemon.estimate.tones.tone_detector import PILOT_TOLERANCE, capture_band_hz
from resonator_daemon.estimate.tones.tone_windows import GateBlock, ToneWindows, Window
from resonator_daemon.measure.sensors.corner_tones import CornerTones
from resonator_daemon.measure.sensors.force_sensor import ForceProcessing
from resonator_daemon.measure.sensors.output import COMMON_MODE_PENDING

_SITE: Final = attrgetter("site")
BASELINE_READINGS: Final = 20  # untouched readings before the common mode counts as known
ONSET_FRAMES: Final = 2  # window of the fast path
CROWDED_FRAMES: Final = 3

_PRESSED: Final = Reason(ReasonCode.PRESSED_AT_START, "touched before the pilot was detected on all channels")
_SECOND_TONE: Final = Reason(ReasonCode.SECOND_TONE, "a tone besides the counted one is detected")
_OTHER_SITE: Final = Reason(ReasonCode.OTHER_SITE, "another site is detected instead")
_ONE_CHANNEL: Final = Reason(ReasonCode.TOO_FEW_CHANNELS, "detected on 1 channel, at least 2 needed")


class SingleToneProcessing(ForceProcessing):
    """Frames of a single-tone board in, readings out."""

    def __init__(
        self,
        sites: ForceSites,
        *,
        pilot_hz: float,
        reference_hz: float,
        gate_s: float,
        window_frames: int,
        step_frames: int,
        load_sharing_exponent: float | None = None,
        tones_period_frames: int | None = None,
    ) -> None:
        """Initialise with a plate's sites; a touch loads them by distance^-exponent, None: they are touched singly.

        Readings have the tones of the corners once in `tones_period_frames`; None: never.
        """
        super().__init__(sites, reference_hz=reference_hz, gate_s=gate_s)
        channels = sites.f0_hz.shape[1]
        hidden = None
        if load_sharing_exponent is not None:
            hidden = hidden_fraction(sites.positions_m, sites.outline_m, load_sharing_exponent)
        self._pilot_hz = pilot_hz
        self._windows = ToneWindows(channels, window_frames, reference_hz, capture_band_hz(pilot_hz, sites.f0_hz))
        reading_std = oscillator_std(window_frames * gate_s)
        self._common_mode = CommonMode(channels, needed=BASELINE_READINGS, reading_std=reading_std)
        self._noise = OscillatorNoise()
        self._matcher = Matcher(
            sites.f0_hz,
            sites.sensitivity,
            sites.force_max_newton,
            model_error=sites.model_error,
            hidden_fraction=hidden,
        )
        # Two tones on a channel at once are so far apart at least, by channel.
        shifted_hz = 2.0 * float(np.abs(sites.sensitivity).max()) * sites.force_max_newton * sites.f0_hz.max(axis=0)
        codes_hz = np.diff(np.sort(sites.f0_hz, axis=0), axis=0)
        apart_hz = codes_hz.min(axis=0) if len(codes_hz) else np.full(channels, np.inf)
        self._apart_hz: list[float] = (apart_hz - shifted_hz).tolist()
        self._latch = OverloadLatch()
        self._corner_tones = CornerTones(sites, tones_period_frames)
        self._no_pilot = (math.nan,) * channels
        self._pilot_attenuation_db = [math.nan] * channels
        self._touch_sites: set[int] = set()  # by the last reading
        self._quiet = [0] * channels
        self._crowded = self._quiet  # frames in a row in which no tone was the strongest
        self._pilot: tuple[float, ...] = self._no_pilot  # g by the pilot in the last reading
        self.unusable: Counter[str] = Counter()  # records that gave no frequency, by cause
        self._measure_over(window_frames, step_frames)

    def _reset(self) -> None:
        self._windows.restart()
        self._common_mode.reset()
        self._noise = OscillatorNoise()
        self._latch.release()
        self._crowded = self._quiet
        self._pilot = self._no_pilot

    def tare(self) -> str | None:
        if any(map(math.isnan, self._pilot)):
            return "the pilot is not detected on all channels: the plate is touched, or channels are silent"
        self._common_mode.tare(self._pilot)
        return None

    def _measure_over(self, window_frames: int, step_frames: int) -> None:
        self._windows.resize(window_frames)
        self._common_mode.expect(oscillator_std(window_frames * self._gate_s))
        self._step_frames = step_frames
        self._window_frames = window_frames
        self._onset_frames = min(ONSET_FRAMES, window_frames)
        least_hz = 1.0 / (window_frames * self._gate_s)
        self._distance_hz = [max(apart_hz, least_hz) for apart_hz in self._apart_hz]

    @property
    def compensation(self) -> Compensation:
        return self._compensation(untouched=not any(map(math.isnan, self._pilot)))

    def process(self, frames: Sequence[Frame]) -> list[ForceReading]:
        ticks, payloads = [], []
        for frame in frames:
            if isinstance(frame, SingleToneFrame):
                ticks.append(frame.board_ticks)
                payloads.append(frame.payload)
        return self.push(frames[0].index, ticks, b"".join(payloads)) if ticks else []

    def push(self, first_sequence: int, board_ticks: Sequence[int], payload: bytes) -> list[ForceReading]:
        """Process adjacent frames: their records as on the wire, one of each channel, frame after frame.

        Returns a reading at every `step_frames`-th sequence number, and between them where something has happened to a
        contact; how the frames are cut into blocks changes none. `first_sequence` is that of the first frame and
        `board_ticks` are those at the end of each; both are unwrapped. Frames that are missing between two calls
        restart the windows.
        """
        if self._last is not None and first_sequence != self._last[0] + 1:
            self._windows.restart()
        block = self._windows.push(payload)
        crowded = self._note(block)
        changed = self._tone_has_changed(block)
        others: list[int] | None = None  # looked for while nothing is touched
        step, count = self._step_frames, len(block.held)
        self._last = first_sequence + count - 1, board_ticks[-1]
        steps = range(-(first_sequence + 1) % step, count, step)
        readings = []
        touched = bool(self._tracker.contacts)
        for gate in range(count):
            at_step = gate in steps
            if not at_step:
                if others is None and not touched:
                    others = self._other_tones(block)
                something_new = gate in (changed if touched else others or ())
                if not (something_new and self._common_mode.known):
                    continue
            window = self._window_at(block, gate)
            reading = self._read(first_sequence + gate, board_ticks[gate], window, crowded[gate], at_step=at_step)
            touched = bool(reading.contacts)
            if at_step or reading.events:
                readings.append(reading)
        return readings

    def _window_at(self, block: GateBlock, gate: int) -> Window:
        """Return the window that ends with a gate."""
        # A window that has begun again grows from that of the fast path: a new tone is known at once, and better soon.
        most, held = self._window_frames, block.held[gate]
        if min(held) < most:
            most = min([count for count in held if count >= self._onset_frames], default=most)
        return block.window(gate, most)

    def _note(self, block: GateBlock) -> list[list[int]]:
        """Count unusable records; return for how many frames in a row no tone was the strongest on each channel."""
        if not block.faults:
            self._crowded = self._quiet
            return [self._quiet] * len(block.held)
        self.unusable.update(block.count_faults())
        rows = []
        for faults in block.faults:
            self._crowded = [
                count + 1 if fault == CAPTURE_SWITCH else 0 for count, fault in zip(self._crowded, faults, strict=True)
            ]
            rows.append(self._crowded)
        return rows

    def _tone_has_changed(self, block: GateBlock) -> list[int]:
        """Return the gates at which a channel has had a new tone, or its own again, for exactly an onset's time."""
        first, second = self._onset_frames, self._onset_frames + 1
        if block.steady and self._window_frames > second:
            return []
        return [gate for gate, held in enumerate(block.held) if first in held or second in held]

    def _other_tones(self, block: GateBlock) -> list[int]:
        """Return the gates at which at least two channels have had another tone than the pilot for long enough."""
        onset = self._onset_frames
        return [
            gate
            for gate, (off, held) in enumerate(
                zip(block.other_tones(self._pilot_hz, PILOT_TOLERANCE), block.held, strict=False)
            )
            if sum([other and count >= onset for other, count in zip(off, held, strict=True)]) >= 2
        ]

    def _read(
        self, sequence: int, board_ticks: int, window: Window, crowded: list[int], *, at_step: bool
    ) -> ForceReading:
        frames, measured_hz = window.frames, window.frequency_hz
        pilot_hz, tolerance, unknown = self._pilot_hz, PILOT_TOLERANCE, math.nan
        relative_hz = [unknown] * len(measured_hz)
        for channel, f in enumerate(measured_hz):
            if -tolerance < (g := f / pilot_hz - 1) < tolerance:
                relative_hz[channel] = g
        pilot = tuple(relative_hz)
        silent, others = sum(map(math.isnan, measured_hz)), sum(map(math.isnan, pilot))
        pilots, tones = len(pilot) - others, others - silent
        untouched = tones == 0 and pilots >= 2
        self._follow(board_ticks, pilot, window, untouched=untouched and frames == self._window_frames)

        status: SensorStatus
        reason: Reason | None
        forces: tuple[SiteForce, ...] = ()
        beats: tuple[int, ...] = ()
        if untouched:
            status, reason = (
                ("ok", self._missing(window)) if self._common_mode.known else self._estimating(pilots, window)
            )
        elif tones and not self._common_mode.known:
            status, reason = "pressed_at_start", _PRESSED
        elif tones >= 2:
            counts = self._counted(window, measured_hz, pilot)
            second_tone = False
            for channel, count in enumerate(counts):
                second_tone = second_tone or count.others
                if count.beats:
                    beats += (channel,)
            match = self._latch.apply(self._match(counts, frames))
            status, reason, forces = match.status, match.reason, match.forces
            if status == "ok" and second_tone:
                status, reason = "possibly_more", _SECOND_TONE
            elif status == "ok" and max(crowded) >= CROWDED_FRAMES:
                status, reason = "possibly_more", self._tones_alike("two tones are alike", window)
        else:
            status, reason = self._silent(tones, pilots, window)

        tones_due = at_step and self._corner_tones.due(sequence)
        corner_tones = self._tones(window, measured_hz, pilot, forces) if tones_due else None
        touches: list[Touch] = []
        if forces:
            time_s = board_ticks / self._reference_hz
            forces = self._complete(forces, time_s, status)
            positions_m, covariance_m2 = self._positions_m, self._covariance_m2
            touches = [touch_of(force, positions_m[force.site], covariance_m2[force.site]) for force in forces]
        touches = self._confirmed(touches, frames)
        absent = ("no_signal", _OTHER_SITE) if forces else (status, reason)
        events = self._tracker.update(board_ticks, touches, complete=untouched, status=absent[0], reason=absent[1])
        return ForceReading(
            sequence,
            board_ticks,
            frames * self._gate_s,
            at_step,
            status,
            reason,
            forces,
            self._tracker.contacts,
            events,
            self._compensation(untouched=untouched),
            beats,
            corner_tones,
        )

    def _tones(
        self, window: Window, measured_hz: Sequence[float], pilot: Sequence[float], forces: Sequence[SiteForce]
    ) -> tuple[CornerTone, ...]:
        counts = self._counted(window, measured_hz, self._no_pilot)  # the pilot's channels, too
        held = [fault is None for fault in window.faults]
        common_mode = self._common_mode.value, self._common_mode.std
        oscillator = oscillator_std(window.frames * self._gate_s, self._noise.std_1s)
        return self._corner_tones.tones(counts, pilot, held, forces, common_mode, oscillator)

    def _follow(self, board_ticks: int, pilot: tuple[float, ...], window: Window, *, untouched: bool) -> None:
        """Update the baseline with the pilot while nothing is touched; otherwise increase its uncertainty."""
        before = board_ticks if self._evaluated_ticks is None else self._evaluated_ticks
        self._evaluated_ticks = board_ticks
        elapsed_s = max(board_ticks - before, 0) / self._reference_hz
        # Channels without a signal stay out of it: a touch would have taken the pilot's place on the others, too.
        self._common_mode.update(pilot if untouched else self._no_pilot, elapsed_s)
        self._pilot = pilot
        if untouched:
            self._latch.release()
            time_s, known = board_ticks / self._reference_hz, [g for g in pilot if g == g]
            self._errors.silence(time_s)
            variance = sum([counter_std(sums) ** 2 for sums in window.sums if sums is not None]) / len(known) ** 2
            self._noise.update(time_s, sum(known) / len(known), variance, window.frames * self._gate_s)
            self._pilot_attenuation_db = [
                before if math.isnan(g) else now
                for g, before, now in zip(pilot, self._pilot_attenuation_db, window.attenuation_db, strict=True)
            ]

    def _counted(self, window: Window, measured_hz: Sequence[float], pilot: Sequence[float]) -> list[ToneCount]:
        """Return what each channel with another tone than the pilot counts, and how well."""
        counts = [NO_TONE] * len(pilot)
        attenuation_db = window.attenuation_db
        residual_ticks2 = window.residual_ticks2
        pilot_hz = [self._pilot_hz * (1.0 + (g if g == g else 0.0)) for g in self._common_mode.value]
        for channel, (sums, g) in enumerate(zip(window.sums, pilot, strict=True)):
            if sums is not None and math.isnan(g):
                counts[channel] = count_tone(
                    sums,
                    measured_hz[channel],
                    residual_ticks2[channel],
                    reference_hz=self._reference_hz,
                    pilot_hz=pilot_hz[channel],
                    over_pilot_db=attenuation_db[channel] - self._pilot_attenuation_db[channel],
                    distance_hz=self._distance_hz[channel],
                    window_s=window.frames * self._gate_s,
                )
        return counts

    def _match(self, counts: Sequence[ToneCount], frames: int) -> Match:
        common_mode = self._common_mode
        frequency_hz = [count.frequency_hz / (1.0 + g) for count, g in zip(counts, common_mode.value, strict=True)]
        oscillator = oscillator_std(frames * self._gate_s, self._noise.std_1s)
        return self._matcher.match(frequency_hz, [count.std for count in counts], oscillator, common_mode.std)

    def _complete(self, forces: tuple[SiteForce, ...], time_s: float, status: SensorStatus) -> tuple[SiteForce, ...]:
        """Return the forces with the sites' response taken out and with every systematic error."""
        within = [force for force in forces if force.status != "overload"]
        pressed = self._errors.press(
            np.array([force.site for force in within], np.intp),
            np.array([force.force_newton for force in within]),
            np.array([force.noise_newton for force in within]),
            np.array([force.systematic_newton for force in within]),
            np.array([self._sites.newton_per_shift(force.site, force.channels) for force in within]),
            time_s,
            np.ones(len(within), np.bool_),
        )
        systematic = np.hypot(pressed.systematic_newton, pressed.unmodelled_newton)
        parts = (pressed.force_newton, pressed.noise_newton, systematic, pressed.calibrated)
        worth: Literal["ok", "possibly_more"] = "possibly_more" if status == "possibly_more" else "ok"
        for force, newton, noise, other, calibrated in zip(within, *(part.tolist() for part in parts), strict=True):
            force.force_newton, force.noise_newton, force.systematic_newton = newton, noise, other
            force.status = worth if calibrated else "uncalibrated"
        return forces

    def _confirmed(self, touches: list[Touch], frames: int) -> list[Touch]:
        """Return the touches; of a window that has just begun only those that the frame before had, too.

        While a tone takes over a corner, a window of two gates may give any site.
        """
        before, self._touch_sites = self._touch_sites, set(map(_SITE, touches))
        if frames > self._onset_frames:
            return touches
        known = before | {contact.touch.site for contact in self._tracker.contacts}
        return [touch for touch in touches if touch.site in known]

    def _compensation(self, *, untouched: bool) -> Compensation:
        common_mode = self._common_mode
        return Compensation(
            common_mode.value,
            common_mode.std,
            ("followed" if untouched else "held") if common_mode.known else "unknown",
            math.nan,
            math.nan,
            self._response,
        )

    def _estimating(self, pilots: int, window: Window) -> tuple[SensorStatus, Reason | None]:
        if pilots == self._windows.channels or self._settling(window):
            return "settling", COMMON_MODE_PENDING
        return "pilot_lost", self._missing(window)

    def _silent(self, tones: int, pilots: int, window: Window) -> tuple[SensorStatus, Reason | None]:
        """Return the status where too few channels have a signal to distinguish a touch from none."""
        if self._settling(window):
            return "settling", self._missing(window)
        if tones:
            return "rejected", _ONE_CHANNEL
        if "capture_switch" in window.faults:
            return "rejected", self._tones_alike("no tone is the strongest for long", window)
        return ("pilot_lost" if pilots else "no_signal"), self._missing(window)

    def _settling(self, window: Window) -> bool:
        return any(
            fault is None and held < self._window_frames for fault, held in zip(window.faults, window.held, strict=True)
        )

    def _missing(self, window: Window) -> Reason | None:
        """Name the channels that give no frequency, each with its cause; None if there are none."""
        if min(window.held) == self._window_frames:
            return None
        causes = [
            f"channel {channel}: {FAULTS_IN_WORDS[fault] if fault else 'window not full yet'}"
            for channel, (fault, held) in enumerate(zip(window.faults, window.held, strict=True))
            if held < self._window_frames
        ]
        silent = any(fault is not None for fault in window.faults)
        return Reason(ReasonCode.CHANNELS_SILENT if silent else ReasonCode.WINDOW_NOT_FULL, ", ".join(causes))

    def _tones_alike(self, text: str, window: Window) -> Reason:
        missing = self._missing(window)
        return Reason(ReasonCode.TONES_ALIKE, f"{text}: {missing.text if missing else ''}")
