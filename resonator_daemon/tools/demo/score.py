"""How well a plate's messages agree with the emulator's truth, by the definitions in the contract of `demo --json`."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.mqtt.codec import read_arrays
from resonator_daemon.mqtt.payloads import Lost
from resonator_daemon.mqtt.topics import CONTACT_EVENT, CONTACTS, DECODED, FORCES, HEALTH, STATE_DAEMON, TOPICS
from resonator_daemon.tools.demo.truth import TruthLine, TruthTable, site_traction, surface_traction
from simulators.presses import FIRST_ID

ONSET_NEWTON = 0.020  # a touch counts from here
FOUND_WITHIN_NS = 50_000_000
COUNTED_SHARE = 0.05  # errors count where a force exceeds this share of its peak
_AFTER_HAND_NS: Final = 200_000_000  # after a press by hand: its contact is released, its window has passed

_ALWAYS: Final = (CONTACT_EVENT, HEALTH, STATE_DAEMON)
SCORED_OF_FORCES: Final = tuple(TOPICS[topic.path] for topic in (FORCES, *_ALWAYS))
SCORED_OF_SKIN: Final = tuple(TOPICS[topic.path] for topic in (DECODED, CONTACTS, *_ALWAYS))


@dataclass(slots=True)
class TrueTouch:
    """One touch of the truth: where, how hard, and when it became one that counts."""

    site: int | None
    crossed_ns: int | None = None
    peak_newton: float = 0.0
    scored: bool = True  # False where somebody pressed at the same time


class Onset(NamedTuple):
    """An onset that was received; times in UTC."""

    t_ns: int
    site: int
    arrived_ns: int


class _Waiting(NamedTuple):
    """A message whose truth has not been written yet."""

    path: str
    fields: Mapping[str, Any]
    arrived_ns: int


@dataclass(slots=True)
class Accuracy:
    """What one plate's run amounts to; None where the plate has no such thing."""

    latency_ms: list[float] = field(default_factory=list)
    touches: int = 0
    found: int = 0
    late_ms: list[float] = field(default_factory=list)  # of touches found late: from the crossing to the arrival
    force_error_newton_rms: float | None = None
    position_error_m_rms: float | None = None
    traction_error: float | None = None


class PlateScore:
    """Comparison of the messages of one plate with the truth, as both come in.

    Only the fields that are scored are read, without a check by the models of the messages.

    Parameters
    ----------
    truth
        Of the emulated board.
    frame_rate_hz
        Of the board: a window of the `forces` topic is so many gates long.
    site_positions_m
        (n, 2): where the traction of scattered sites is compared with the truth, point by point.
    touched_anywhere
        The plate has a skin: the site of an onset is only the nearest one, and is not compared.

    Attributes
    ----------
    messages_missed
        Gaps in `seq` of `forces` and `decoded` since counting began: skipped, not decoded, or lost on the way.
    health
        Messages of `health`, from the one at which counting began to the daemon's last.
    by_hand
        Ids of the touches that somebody made through the control socket. Neither they nor what was touched at the same
        time are scored.
    started, begun, ended
        A first result was received; counting has begun; the daemon has published that it is offline, its last message.
    """

    def __init__(
        self,
        truth: TruthTable,
        frame_rate_hz: float,
        site_positions_m: NDArray[np.float64],
        *,
        touched_anywhere: bool = False,
    ) -> None:
        self._truth = truth
        self._frame_rate_hz = frame_rate_hz
        self._site_positions_m = site_positions_m
        self._touched_anywhere = touched_anywhere
        self._waiting: list[_Waiting] = []
        self._onsets: list[Onset] = []
        self._touches: dict[int, TrueTouch] = {}
        self._force_errors: list[tuple[int, float, float]] = []  # touch, true force, error
        self._position_errors: list[tuple[int, float, float]] = []  # touch, true force, distance
        self._traction_errors: list[tuple[float, float, float]] = []  # net force, squared error, squared truth
        self._begin_ns = 0
        self._losses = dict.fromkeys(Lost.model_fields, 0)
        self._losses_before = self._losses.copy()
        self.latency_ms: list[float] = []
        self.decoded_frames = 0
        self.messages_missed = 0
        self._newest_seq: dict[str, int] = {}  # by path
        self.health: list[Mapping[str, Any]] = []
        self.by_hand: set[int] = set()
        self._by_hand_ns = -_AFTER_HAND_NS  # of the latest line with such a touch
        self.started = self.begun = self.ended = False
        self._begin_asked = False

    def begin(self) -> None:
        """Count from the next `health` on, which has all counters: what came before belongs to the set-up."""
        self._begin_asked = True

    @property
    def frames(self) -> int:
        """Number of frames that the daemon has received since counting began, by its last `health`."""
        return self._since_begin("frames")

    @property
    def lost(self) -> dict[str, int]:
        """Losses since counting began, by cause."""
        return {cause: count - self._losses_before[cause] for cause, count in self._losses.items()}

    @property
    def losses(self) -> dict[str, int]:
        """Losses since counting began, by cause, with parts of frames and frames that were not decoded."""
        parts, not_decoded = self._since_begin("parts_lost"), self._since_begin("frames_not_decoded")
        return self.lost | {"parts": parts, "not_decoded": not_decoded}

    def add(self, path: str, payload: bytes, arrived_ns: int) -> None:
        """Add a message of the topic with this path and its time of arrival (UTC)."""
        if path == DECODED.path:
            self.decoded_frames += 1
            message = read_arrays(payload)
            self._count_missed(path, message["seq"])
            self._waiting.append(_Waiting(path, message, arrived_ns))
            return
        message = json.loads(payload)
        self._count(message["lost"])
        if path in (FORCES.path, CONTACTS.path):
            self.started = True
            if path == FORCES.path:
                self._count_missed(path, message["seq"])
            self._waiting.append(_Waiting(path, message, arrived_ns))
        elif path == CONTACT_EVENT.path:
            if message["event"] == "onset":
                self._onsets.append(Onset(int(message["t_ns"]), message["contact"]["site"], arrived_ns))
        elif path == HEALTH.path:
            if self._begin_asked:
                self._count_from(arrived_ns)
            self.health.append(message)
        elif path == STATE_DAEMON.path:
            self.ended = message["state"] == "offline"

    def _count_from(self, arrived_ns: int) -> None:
        self._begin_asked, self.begun = False, True
        self._begin_ns = arrived_ns
        for earlier in (self._waiting, self.latency_ms, self.health):
            earlier.clear()
        for errors in (self._force_errors, self._position_errors, self._traction_errors):
            errors.clear()
        self.decoded_frames = self.messages_missed = 0
        self._losses_before = self._losses.copy()

    def _since_begin(self, counter: str) -> int:
        return int(self.health[-1][counter]) - int(self.health[0][counter]) if self.health else 0

    def _count_missed(self, path: str, seq: int) -> None:
        if (newest := self._newest_seq.get(path)) is not None:
            self.messages_missed += max(seq - newest - 1, 0)
        self._newest_seq[path] = seq

    def _count(self, losses: Mapping[str, int]) -> None:
        if sum(losses.values()) >= sum(self._losses.values()):  # a state may come after messages that were made later
            self._losses.update(losses)

    def join(self) -> None:
        """Compare the messages whose truth has been written by now."""
        for line in self._truth.read_on():
            if line.contacts:
                self._follow_touches(line)
        newest_ns = self._truth.lines[-1].t_ns if self._truth.lines else 0
        still_waiting = []
        for waiting in self._waiting:
            path, message, arrived_ns = waiting
            frames = round(message["window_s"] * self._frame_rate_hz) if path == FORCES.path else 1
            window = self._truth.window(int(message["board_ticks"] or 0), frames)
            if window is None:
                if arrived_ns > newest_ns:  # else the truth does not have it
                    still_waiting.append(waiting)
                continue
            last = window[-1]
            if path != CONTACTS.path:
                self.latency_ms.append((arrived_ns - last.t_ns) / 1e6)
            if last.t_ns < self._by_hand_ns + _AFTER_HAND_NS:
                continue
            if path == FORCES.path:
                self._compare_forces(message, [line for line in window if line.contacts], frames)
            elif last.contacts and path == DECODED.path:
                self._compare_tractions(message, last)
            elif last.contacts:
                self._compare_contacts(message, last)
        self._waiting = still_waiting

    def accuracy(self, until_ns: int) -> Accuracy:
        """Return the score of all touches and frames since counting began, to `until_ns` (UTC).

        Each touch is matched with the onset nearest in time at its site; an onset matches one touch at most.
        """
        result = Accuracy(latency_ms=self.latency_ms)
        crossed = [
            (touch.crossed_ns, touch.site)
            for touch in self._touches.values()
            if touch.scored
            and touch.crossed_ns is not None
            and self._begin_ns <= touch.crossed_ns <= until_ns - FOUND_WITHIN_NS
        ]
        onsets = self._onsets.copy()
        for crossed_ns, site in sorted(crossed, key=lambda touch: touch[0]):
            result.touches += 1
            its = [
                onset
                for onset in onsets
                if abs(onset.t_ns - crossed_ns) <= FOUND_WITHIN_NS and (self._touched_anywhere or onset.site == site)
            ]
            if not its:
                continue
            onset = min(its, key=lambda onset: abs(onset.t_ns - crossed_ns))
            onsets.remove(onset)
            result.found += 1
            if onset.arrived_ns - crossed_ns > FOUND_WITHIN_NS:
                result.late_ms.append((onset.arrived_ns - crossed_ns) / 1e6)
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
        by_hand = {contact["id"] for contact in line.contacts if contact["id"] >= FIRST_ID}
        if by_hand:
            self.by_hand |= by_hand
            self._by_hand_ns = line.t_ns
            for touch in self._touches.values():  # lifted before it can have been found
                touch.scored &= touch.crossed_ns is None or touch.crossed_ns < line.t_ns - FOUND_WITHIN_NS
        for contact in line.contacts:
            touch = self._touches.setdefault(contact["id"], TrueTouch(contact["site"]))
            if line.t_ns < self._by_hand_ns + _AFTER_HAND_NS:
                touch.scored = False
            normal_newton = contact["force_newton"][2]
            touch.peak_newton = max(touch.peak_newton, normal_newton)
            if touch.crossed_ns is None and normal_newton >= ONSET_NEWTON:
                touch.crossed_ns = line.t_ns

    def _compare_forces(self, message: Mapping[str, Any], touched: list[TruthLine], frames: int) -> None:
        """Compare forces with the mean truth of a window of `frames` gates; `touched` are those with a contact."""
        true_newton: dict[int, float] = {}
        site_of: dict[int, Any] = {}
        for line in touched:
            for contact in line.contacts:
                share = contact["force_newton"][2] / frames
                true_newton[contact["id"]] = true_newton.get(contact["id"], 0.0) + share
                site_of[contact["id"]] = contact["site"]
        measured = {site["site"]: site["force_newton"] for site in message["sites"]}
        for touch, true in true_newton.items():
            force_newton = measured.get(site_of[touch])
            if force_newton is not None:  # None has a status instead: no error of the force
                self._force_errors.append((touch, true, force_newton - true))

    def _compare_contacts(self, message: Mapping[str, Any], line: TruthLine) -> None:
        """Compare each true contact with the measured one nearest to it."""
        measured = [
            found for found in message["contacts"] if None not in (*found["position_m"], *found["force_newton"])
        ]
        for contact in line.contacts if measured else ():
            away_m = [math.dist(found["position_m"], contact["position_m"]) for found in measured]
            nearest = int(np.argmin(away_m))
            true_newton = contact["force_newton"][2]
            error_newton = measured[nearest]["force_newton"][2] - true_newton
            self._force_errors.append((contact["id"], true_newton, error_newton))
            self._position_errors.append((contact["id"], true_newton, away_m[nearest]))

    def _compare_tractions(self, message: Mapping[str, Any], line: TruthLine) -> None:
        measured = message["traction_pascal"].astype(np.float64)
        if np.isnan(measured).any():  # not estimated, as its status shows
            return
        if message["grid"] is None:
            truth = site_traction(line, self._site_positions_m)
        else:
            ny, nx = measured.shape[-2:]
            truth = surface_traction(line, (ny, nx), message["grid"]["pitch_m"])
        error = measured - truth
        force = float(np.linalg.norm(line.net_force_newton))
        self._traction_errors.append((force, float(np.vdot(error, error)), float(np.vdot(truth, truth))))
