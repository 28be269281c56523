"""How well a plate's messages agree with the emulator's truth, by the definitions in the contract of `demo --json`."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.demo.truth import TruthLine, TruthTable, site_traction, surface_traction
from resonator_daemon.publishing.payloads import (
    ContactEvent,
    Decoded,
    DecodedSummary,
    Forces,
    Header,
    Health,
    Lost,
    Message,
)

ONSET_NEWTON = 0.020  # a touch counts from here
FOUND_WITHIN_NS = 50_000_000
COUNTED_SHARE = 0.05  # errors count where a force exceeds this share of its peak


@dataclass(slots=True)
class TrueTouch:
    """One touch of the truth: where, how hard, and when it became one that counts."""

    site: int | None
    crossed_ns: int | None = None
    peak_newton: float = 0.0


@dataclass(slots=True)
class Accuracy:
    """What one plate's run amounts to; None where the plate has no such thing."""

    latency_ms: list[float] = field(default_factory=list)
    touches: int = 0
    found: int = 0
    sites_right: int = 0
    force_error_newton_rms: float | None = None
    position_error_m_rms: float | None = None
    traction_error: float | None = None


class PlateScore:
    """Joins messages and truth of one plate as both come in.

    Parameters
    ----------
    truth
        Of the emulated board.
    frame_rate_hz
        Of the board: a window of the `forces` topic is so many gates long.
    site_positions_m
        (n, 2): where the traction of scattered sites is compared with the truth, point by point.
    """

    def __init__(self, truth: TruthTable, frame_rate_hz: float, site_positions_m: NDArray[np.float64]) -> None:
        self._truth = truth
        self._frame_rate_hz = frame_rate_hz
        self._site_positions_m = site_positions_m
        self._waiting: list[tuple[Forces | Decoded | DecodedSummary, int]] = []
        self._onsets: list[tuple[int, int]] = []  # arrival, site
        self._touches: dict[int, TrueTouch] = {}
        self._force_errors: list[tuple[int, float, float]] = []  # touch, true force, error
        self._position_errors: list[tuple[int, float, float]] = []  # touch, true force, distance
        self._traction_errors: list[tuple[float, float, float]] = []  # net force, squared error, squared truth
        self._lines_seen = 0
        self._begin_ns = 0
        self._newest_sequence = self._sequence_before = -1  # of the last frame that a message told of
        self._lost = self._lost_before = Lost()
        self.latency_ms: list[float] = []
        self.decoded_frames = 0
        self.health: list[Health] = []

    def begin(self, now_ns: int) -> None:
        """Count from here: what came before belongs to the set-up."""
        self.join()
        self._begin_ns = now_ns
        self.latency_ms.clear()
        self._force_errors.clear()
        self._position_errors.clear()
        self._traction_errors.clear()
        self.decoded_frames = 0
        self._lost_before = self._lost
        self._sequence_before = self._newest_sequence

    @property
    def frames(self) -> int:
        """Frames that the daemon took in since `begin`, by its last word on it."""
        return self.health[-1].frames - (self._sequence_before + 1) if self.health else 0

    @property
    def lost(self) -> dict[str, int]:
        """Losses since `begin`, by cause."""
        before = self._lost_before.model_dump()
        return {cause: count - before[cause] for cause, count in self._lost.model_dump().items()}

    def take(self, message: Message, arrived_ns: int) -> None:
        """Take a message at the moment the subscriber got it."""
        if isinstance(message, Header):
            # A state may come after messages that were made later: losses never become fewer.
            told, known = message.lost.model_dump(), self._lost.model_dump()
            self._lost = Lost(**{cause: max(count, known[cause]) for cause, count in told.items()})
        match message:
            case Forces() | DecodedSummary():
                self._waiting.append((message, arrived_ns))
            case Decoded():
                self.decoded_frames += 1
                self._waiting.append((message, arrived_ns))
            case ContactEvent(event="onset"):
                self._onsets.append((arrived_ns, message.contact.site))
            case Health():
                self.health.append(message)

    def join(self) -> None:
        """Compare the messages whose truth has been written by now."""
        self._truth.read_on()
        for line in self._truth.lines[self._lines_seen :]:
            self._follow_touches(line)
        self._lines_seen = len(self._truth.lines)
        still_waiting = []
        for message, arrived_ns in self._waiting:
            frames = round(message.window_s * self._frame_rate_hz) if isinstance(message, Forces) else 1
            window = self._truth.window(message.board_ticks or 0, frames)
            if window is None:
                still_waiting.append((message, arrived_ns))
                continue
            self._newest_sequence = window[-1].sequence
            if isinstance(message, DecodedSummary):
                self._compare_patches(message, window[0])
                continue
            self.latency_ms.append((arrived_ns - window[-1].t_ns) / 1e6)
            if isinstance(message, Forces):
                self._compare_forces(message, window)
            else:
                self._compare_tractions(message, window[0])
        self._waiting = still_waiting

    def accuracy(self, until_ns: int) -> Accuracy:
        """Return the score of everything that was true from `begin` to `until_ns`, UTC."""
        result = Accuracy(latency_ms=self.latency_ms)
        for touch in self._touches.values():
            crossed_ns = touch.crossed_ns
            if crossed_ns is None or not self._begin_ns <= crossed_ns <= until_ns - FOUND_WITHIN_NS:
                continue
            result.touches += 1
            sites = [site for at, site in self._onsets if abs(at - crossed_ns) <= FOUND_WITHIN_NS]
            result.found += bool(sites)
            result.sites_right += touch.site in sites
        result.force_error_newton_rms = self._rms(self._force_errors)
        result.position_error_m_rms = self._rms(self._position_errors)
        if self._traction_errors:
            force, error, truth = np.array(self._traction_errors).T
            counted = force > COUNTED_SHARE * force.max()
            if truth[counted].sum() > 0:
                result.traction_error = math.sqrt(error[counted].sum() / truth[counted].sum())
        return result

    def _rms(self, errors: list[tuple[int, float, float]]) -> float | None:
        counted = [error for touch, true, error in errors if true > COUNTED_SHARE * self._touches[touch].peak_newton]
        return float(np.sqrt(np.mean(np.square(counted)))) if counted else None

    def _follow_touches(self, line: TruthLine) -> None:
        for contact in line.contacts:
            touch = self._touches.setdefault(contact["id"], TrueTouch(contact["site"]))
            normal_newton = contact["force_newton"][2]
            touch.peak_newton = max(touch.peak_newton, normal_newton)
            if touch.crossed_ns is None and normal_newton >= ONSET_NEWTON:
                touch.crossed_ns = line.t_ns

    def _compare_forces(self, message: Forces, window: list[TruthLine]) -> None:
        true_newton: dict[int, float] = {}
        site_of: dict[int, Any] = {}
        for line in window:
            for contact in line.contacts:
                share = contact["force_newton"][2] / len(window)
                true_newton[contact["id"]] = true_newton.get(contact["id"], 0.0) + share
                site_of[contact["id"]] = contact["site"]
        measured = {site.site: site.force_newton for site in message.sites}
        for touch, true in true_newton.items():
            error = measured.get(site_of[touch], math.nan) - true
            if not math.isnan(error):  # what is not known is said so by its status, and is no error of the force
                self._force_errors.append((touch, true, error))

    def _compare_patches(self, message: DecodedSummary, line: TruthLine) -> None:
        """Compare each true contact with the patch nearest to it."""
        for contact in line.contacts if message.patches else ():
            away_m = [math.dist(patch.centroid_m, contact["position_m"]) for patch in message.patches]
            nearest = int(np.argmin(away_m))
            true_newton = contact["force_newton"][2]
            error_newton = message.patches[nearest].force_newton[2] - true_newton
            self._force_errors.append((contact["id"], true_newton, error_newton))
            self._position_errors.append((contact["id"], true_newton, away_m[nearest]))

    def _compare_tractions(self, message: Decoded, line: TruthLine) -> None:
        if np.isnan(message.traction_pascal).any():  # not known, as its status says
            return
        if message.grid is None:
            truth = site_traction(line, self._site_positions_m)
        else:
            ny, nx = message.traction_pascal.shape[-2:]
            truth = surface_traction(line, (ny, nx), message.grid.pitch_m)
        error = np.asarray(message.traction_pascal, np.float64) - truth
        force = float(np.linalg.norm(line.net_force_newton))
        self._traction_errors.append((force, float(np.sum(error**2)), float(np.sum(truth**2))))
