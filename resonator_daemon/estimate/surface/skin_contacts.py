"""Contacts on a skin over time: which patch is which, its forces, onset and release, margin to slip."""

import math
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from resonator_daemon.base.arrays import Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.surface.decoded import SIGNAL_LIMIT
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.fit_check import FRAMES, P_LEAST, FitQuality, RestScatter, contradicts
from resonator_daemon.estimate.surface.fitting.partial_slip import ContactStart, Friction, PartialSlip
from resonator_daemon.estimate.surface.fitting.shape_fit import ShapeFit, ShapeFitter
from resonator_daemon.estimate.surface.fitting.slip_fitter import SlipWatch
from resonator_daemon.estimate.surface.fitting.slip_signals import FORCE_X, FORCE_Z, MARGIN, RADIUS
from resonator_daemon.estimate.surface.fitting.systematic import Offset
from resonator_daemon.estimate.surface.patches import Patch
from resonator_daemon.estimate.surface.skin import Skin

_PATIENCE = 2  # frames for which a patch may be missing and still keep its id
_LEAST_REACH_M = 1e-3  # that a patch may move between frames; else its radius

_ONSET_FRAMES = 2  # in a row: a patch of one frame may be noise
_SIGNIFICANCE = 6.0  # standard deviations of the normal force at onset
RADIUS_SHARE = 0.5  # of the sites' extent: contacts are no larger
_NOISE_CHANGE = 0.05  # relative, of a signal's standard deviation: a fit with other weights linearises again
_OFFSET_GAIN = 0.4  # of following a common offset ...
_OFFSET_LEAST = 5.0  # ... which is taken off if it is above so many standard deviations of a frame's
_OFFSET_LARGE = 5.0  # standard deviations of a signal, from where on the median of the signals shows it, too
_FRICTION_STD = 0.03  # relative, of a coefficient that is given: friction changes, and models are wrong
_FRICTION_KNOWN = 0.1  # relative standard deviation at which an estimate begins to bound shear


@dataclass
class _PatchTrack:
    centroid_m: list[float]
    reach_m: float
    missed: int = 0


class PatchTracker:
    """Tracker of patches, whose ids they keep while they move by less than their radius, or 1 mm, a frame.

    A patch that is missing for two frames keeps its id.

    Attributes
    ----------
    last_id
        The largest that was given so far; the next one follows it.
    """

    def __init__(self) -> None:
        self._tracks: dict[int, _PatchTrack] = {}
        self.last_id = 0

    @property
    def ids(self) -> frozenset[int]:
        """Of all patches that are followed, those that are missing for the moment among them."""
        return frozenset(self._tracks)

    def clear(self) -> None:
        """Discard all tracks."""
        self._tracks = {}

    def update(self, patches: Sequence[Patch]) -> dict[int, Patch]:
        """Return the patches of a frame by id, from 1; they are matched so that their moves are least in total."""
        ids = list(self._tracks)
        centroids_m = [patch.centroid_m.tolist() for patch in patches]
        moves_m = [[math.dist(self._tracks[i].centroid_m, centroid_m) for centroid_m in centroids_m] for i in ids]
        matched = _match(moves_m, [self._tracks[i].reach_m for i in ids]) if ids and patches else {}
        id_of = {column: ids[row] for row, column in matched.items()}
        for column in range(len(patches)):
            if column not in id_of:
                self.last_id += 1
                id_of[column] = self.last_id
        for track in self._tracks.values():
            track.missed += 1
        for column, i in id_of.items():
            self._tracks[i] = _PatchTrack(centroids_m[column], max(patches[column].radius_m, _LEAST_REACH_M))
        self._tracks = {i: track for i, track in self._tracks.items() if track.missed <= _PATIENCE}
        return {i: patches[column] for column, i in id_of.items()}


def _match(moves_m: list[list[float]], reach_m: list[float]) -> dict[int, int]:
    """Assign columns to rows so that the moves within each row's reach are least in total."""
    if len(moves_m) == len(moves_m[0]) == 1:
        pairs = [(0, 0)]
    else:
        moves, reach = np.array(moves_m), np.array(reach_m)[:, None]
        # A move beyond reach costs as much as all others together, so that it never displaces one within.
        cost = np.where(moves <= reach, moves, reach.max() * (1 + moves.size))
        pairs = [(int(row), int(column)) for row, column in zip(*linear_sum_assignment(cost), strict=True)]
    return {row: column for row, column in pairs if moves_m[row][column] <= reach_m[row]}


@dataclass(frozen=True)
class Systematic:
    """Standard deviations of what the uncertainty of the skin changes and time does not average out; NaN: not known."""

    force_newton: Floats  # (3,)
    position_m: Floats  # (2,)
    radius_m: float
    slip_margin: float
    friction_coefficient: float

    @classmethod
    def of(cls, slip: PartialSlip) -> "Systematic":
        std = np.sqrt(slip.systematic.diagonal())
        margin = float(std[MARGIN]) if math.isfinite(slip.slip_margin) else math.nan
        return cls(std[FORCE_X:MARGIN], std[:RADIUS], float(std[RADIUS]), margin, slip.friction_coefficient_systematic)


UNKNOWN_SYSTEMATIC = Systematic(np.full(3, np.nan), np.full(2, np.nan), np.nan, np.nan, np.nan)


@dataclass(frozen=True)
class SkinContact:
    """One contact in one frame."""

    id: int
    patch: Patch
    slip: PartialSlip | None = None  # None: nothing was fitted
    fit: FitQuality | None = None  # likewise
    systematic: Systematic = UNKNOWN_SYSTEMATIC
    radius_of_curvature_m: float = np.nan
    radius_of_curvature_std_m: float = np.nan
    peak_newton: float = 0.0  # of the normal force so far
    status: Literal["ok", "contradicted"] = "ok"
    reason: ReasonCode | None = None
    shape_fit: ShapeFit | None = None  # of a punch or an ellipse, whose numbers `patch` and `slip` then have

    @property
    def shape(self) -> Literal["ball", "punch", "ellipse"] | None:
        """The object whose model the signals do not contradict; None while none is known."""
        if self.shape_fit is not None:
            return self.shape_fit.shape
        fits_ball = self.status == "ok" and self.fit is not None and self.fit.p >= P_LEAST
        return "ball" if fits_ball and self.slip is not None and math.isfinite(self.slip.radius_m) else None

    @property
    def area_m2(self) -> float:
        """Of contact where a fit gives its radius, else of the patch."""
        radius_m = self.slip.radius_m if self.slip is not None else math.nan
        return math.pi * radius_m**2 if math.isfinite(radius_m) else self.patch.area_m2

    @property
    def area_std_m2(self) -> float:
        """NaN where no fit gives a radius."""
        return 2.0 * math.pi * self.slip.radius_m * self.slip.radius_std_m if self.slip is not None else math.nan


@dataclass(frozen=True)
class SkinEvent:
    """A contact begins, ends or slips; of one that ends, the contact as it was seen last."""

    event: Literal["onset", "release", "incipient_slip", "gross_slip"]
    contact: SkinContact
    reason: Reason | None = None  # of a release


@dataclass
class _Track:
    last: SkinContact
    frames: int = 0  # in a row in which it was significant
    announced: bool = False
    fits: deque[FitQuality] = field(default_factory=lambda: deque(maxlen=FRAMES))  # of the model that is followed
    shape_fit: ShapeFit | None = None  # punch or ellipse that is followed


class SkinContacts:
    """Tracker of the contacts of one skin.

    Parameters
    ----------
    skin
    noise_std
        Of the signals, gain errors aside, (3, n).
    friction_coefficient
        None where it is not known: then it is estimated from slip.

    Attributes
    ----------
    tracker
        Numbers the contacts.
    friction_estimate
        Estimate from slip so far, None where there is none.
    offset
        By how much each kind of signal is off in all sites, in units of its noise, (3,): what the common mode leaves.
    """

    def __init__(self, skin: Skin, noise_std: Floats, friction_coefficient: float | None) -> None:
        sites_m = skin.site_positions_m
        self._skin = skin
        self._noise_std = noise_std
        self._frame_noise_std = noise_std  # gain errors included
        self._noise_share, self._repeated_share = 1.0, 0.0  # of its square, and of the variance of chi-square
        self._gain_std = skin.gain_std
        self._curvature = 4.0 / 3.0 * skin.half_space.youngs_modulus_pascal / (1.0 - skin.half_space.poisson_ratio**2)
        radius_max_m = RADIUS_SHARE * float(np.ptp(sites_m, axis=0).max())
        self._model = DiscModel(skin.half_space, sites_m, skin.depth_m, radius_max_m)
        known = friction_coefficient
        self._friction = None if known is None else Friction(known, _FRICTION_STD * known)
        self.tracker = PatchTracker()
        self.friction_estimate: float | None = None
        self._tracks: dict[int, _Track] = {}
        self._rest = RestScatter()
        self.offset, self._all_offset = np.zeros((2, 3))
        self._watch = SlipWatch(self._model, self._friction, skin, noise_std)
        self._shapes = ShapeFitter(skin, noise_std, radius_max_m)
        self._contradicted: list[tuple[_Track, Floats, Patch]] = []  # a single contact in the last frame, its signals

    def reset(self, reason: Reason) -> tuple[SkinEvent, ...]:
        """End all contacts for this reason: what follows has nothing in common with what was."""
        ended = tuple(SkinEvent("release", track.last, reason) for track in self._tracks.values() if track.announced)
        self.tracker.clear()
        self._tracks, self._contradicted = {}, []
        self.offset, self._all_offset = np.zeros((2, 3))
        self._watch = SlipWatch(self._model, self._friction, self._skin, self._noise_std)
        return ended

    def start_cold(self) -> None:
        """Discard what was estimated from the frames before: friction, the scatter at rest, gain errors."""
        self.friction_estimate = None
        self.offset, self._all_offset = np.zeros((2, 3))
        self._frame_noise_std = self._noise_std
        self._noise_share, self._repeated_share = 1.0, 0.0
        self._rest = RestScatter()

    def update(
        self, signals: Floats, patches: Sequence[Patch]
    ) -> tuple[tuple[SkinContact, ...], tuple[SkinEvent, ...]]:
        """Return the contacts and events of a frame (3, n) and the patches that were found in it."""
        found = self.tracker.update(patches)
        for missing in self._tracks.keys() - found.keys():
            self._tracks[missing].frames, self._tracks[missing].shape_fit = 0, None
        real = {i: patch for i, patch in found.items() if self._is_real(i, patch)}
        left = None if self._tracks else self._mean_at_rest(signals)
        noise_std = self._noise_of(signals)
        shape = self._followed_shape(real.keys(), signals)
        if shape is None:
            slips, offset = self._watch.update(signals, noise_std, _starts(real)), self._watch.offset
        else:
            slips, offset = dict.fromkeys(real, shape.slip), shape.offset
        self._follow_offset(signals, slips.values(), offset, left)
        self.friction_estimate = _estimated_friction(slips) or self.friction_estimate
        contacts = {i: self._contact(i, patch, slips.get(i), offset, shape) for i, patch in real.items()}
        wrong = [i for i, contact in contacts.items() if contact.status == "contradicted" and len(contacts) == 1]
        self._contradicted = [(self._tracks[i], signals, contacts[i].patch) for i in wrong]
        events = self._follow(contacts)
        events += [SkinEvent(event.event, contacts[event.contact]) for event in self._watch.announce(slips)]
        return tuple(contacts.values()), tuple(events)

    def _mean_at_rest(self, signals: Floats) -> Floats | None:
        """Return the mean of each kind of signal in units of its noise, (3,); None if one is not known."""
        scores = signals / self._noise_std
        if not np.abs(signals).max() <= SIGNAL_LIMIT:
            scores[~(np.abs(signals) <= SIGNAL_LIMIT)] = np.nan
        self._rest.add(scores)
        left: Floats = scores.mean(axis=1)
        if np.isfinite(left).all():
            return left
        return np.nanmean(scores, axis=1) if np.isfinite(scores).any(axis=1).all() else None

    def _followed_shape(self, contacts: Collection[int], signals: Floats) -> ShapeFit | None:
        """Fit the followed shape of a single contact to this frame; None if none is followed, or the fit fails."""
        if len(contacts) != 1:
            return None
        track = self._tracks[next(iter(contacts))]
        if track.shape_fit is not None:
            track.shape_fit = self._shapes.follow(track.shape_fit, signals, self._frame_noise_std)
        return track.shape_fit

    def _follow_offset(
        self, signals: Floats, fits: Collection[PartialSlip], found: Offset | None, left: Floats | None
    ) -> None:
        """Update `offset` from signals that it was subtracted from, by what is `left` in them at rest or after a fit.

        If a fit contradicts its model, `offset` does not change.
        """
        large = np.abs(self.offset) > _OFFSET_LARGE
        if large.any():
            middle = np.nanmedian(signals / self._noise_std, axis=1) + self.offset
            if (
                np.abs(middle[large]) < 0.5 * np.abs(self.offset[large])
            ).all():  # the daemon has updated its common mode
                self.offset, self._all_offset = np.zeros((2, 3))
                return
        if self._tracks and found is not None and fits:
            slip = next(iter(fits))
            chi2 = slip.chi2 - found.chi2_decrease / slip.degrees_of_freedom
            if self._rest.quality(chi2, slip.degrees_of_freedom, 1.0).p > P_LEAST:
                left = found.of_noise
        if left is not None:
            self._all_offset += _OFFSET_GAIN * (self.offset + left - self._all_offset)
            least = _OFFSET_LEAST / math.sqrt(signals.shape[1])
            self.offset = np.where(np.abs(self._all_offset) > least, self._all_offset, 0.0)

    def _is_real(self, contact: int, patch: Patch) -> bool:
        """Return whether a patch is a contact: significant in some frames in a row, then while it is tracked."""
        if contact not in self._tracks:
            self._tracks[contact] = _Track(SkinContact(contact, patch))
        track = self._tracks[contact]
        is_significant = patch.force_newton[2] > _SIGNIFICANCE * patch.force_std_newton[2]
        track.frames = track.frames + 1 if is_significant else 0
        return track.announced or track.frames >= _ONSET_FRAMES

    def _contact(
        self, contact: int, patch: Patch, slip: PartialSlip | None, offset: Offset | None, shape: ShapeFit | None
    ) -> SkinContact:
        track = self._tracks[contact]
        peak_newton = max(track.last.peak_newton, float(patch.force_newton[2]))
        if slip is None or math.isnan(slip.chi2):
            return SkinContact(contact, patch, slip, peak_newton=peak_newton)
        fit = self._quality(slip, offset)
        track.fits.append(fit)
        curvature = self._curvature_m(slip) if shape is None else (math.nan, math.nan)
        found = SkinContact(contact, patch, slip, fit, Systematic.of(slip), *curvature, peak_newton)
        if contradicts(track.fits, self._repeated_share):
            track.shape_fit = None
            return replace(found, status="contradicted", reason=ReasonCode.FIT_CONTRADICTED)
        if shape is None:
            return found
        patch = replace(
            patch,
            force_newton=slip.force_newton,
            force_std_newton=slip.force_std_newton,
            centroid_m=slip.centre_m,
            centroid_std_m=slip.centre_std_m,
        )
        peak_newton = max(peak_newton, float(slip.force_newton[2]))
        return replace(found, patch=patch, shape_fit=shape, peak_newton=peak_newton)

    def _quality(self, slip: PartialSlip, offset: Offset | None) -> FitQuality:
        """Return the goodness of a fit, without the chi-square that an offset explains."""
        decrease = offset.chi2_decrease if offset is not None else 0.0
        chi2 = slip.chi2 - decrease / slip.degrees_of_freedom  # systematic errors cover the offset
        return self._rest.quality(chi2, slip.degrees_of_freedom, self._noise_share)

    def fit_shapes(self, pause: Callable[[], None]) -> None:
        """Fit other shapes to a single contact that contradicts the model of a ball in the last frame.

        The best fit is followed from then on, if the signals do not contradict it. `pause` is called between parts,
        which take about 3 ms each; frames may be decoded there.
        """
        for track, signals, patch in self._contradicted:
            shape = self._shapes.fit(signals, self._frame_noise_std, patch, pause)
            is_current = any(track is other for other, _, _ in self._contradicted)  # frames may have been decoded
            if shape is None or not is_current:
                continue
            quality = self._quality(shape.slip, shape.offset)
            if not contradicts([quality] * FRAMES, self._repeated_share):
                track.shape_fit = shape
                track.fits.clear()

    def _curvature_m(self, slip: PartialSlip) -> tuple[float, float]:
        """Return radius and standard deviation: a^3 = 3 F R (1 - nu^2) / (4 E) (Johnson, Contact Mechanics, 4.2)."""
        force, radius_m = float(slip.force_newton[2]), slip.radius_m
        curvature_m = self._curvature * radius_m**3 / force
        by_radius, by_force, covariance = 3.0 / radius_m, -1.0 / force, slip.covariance
        variance = by_radius**2 * covariance[RADIUS, RADIUS] + by_force**2 * covariance[FORCE_Z, FORCE_Z]
        variance += 2.0 * by_radius * by_force * covariance[RADIUS, FORCE_Z]
        return curvature_m, curvature_m * math.sqrt(variance)

    def _noise_of(self, signals: Floats) -> Floats:
        """Return the standard deviation of noise and gain errors, (3, n).

        That of an earlier frame is kept until one changes by more than 5 %: with others, a fit linearises again.
        """
        if not self._gain_std:
            return self._noise_std
        sound = np.where(np.abs(signals) <= SIGNAL_LIMIT, signals, 0.0)
        noise_std = np.hypot(self._noise_std, self._gain_std * sound)
        if np.abs(noise_std / self._frame_noise_std - 1.0).max() > _NOISE_CHANGE:
            self._frame_noise_std = noise_std
            shares = (self._noise_std / noise_std) ** 2
            self._noise_share, self._repeated_share = float(shares.mean()), float(np.mean((1.0 - shares) ** 2))
        return self._frame_noise_std

    def _follow(self, contacts: Mapping[int, SkinContact]) -> list[SkinEvent]:
        """Onsets and releases; tracks whose patch is no longer tracked end."""
        events = []
        for i, contact in contacts.items():
            track = self._tracks[i]
            track.last = contact
            if not track.announced:
                track.announced = True
                events.append(SkinEvent("onset", contact))
        for i in [i for i in self._tracks if i not in self.tracker.ids]:
            track = self._tracks.pop(i)
            if track.announced:
                text = f"not found in {_PATIENCE + 1} frames in a row"
                events.append(SkinEvent("release", track.last, Reason(ReasonCode.NOT_FOUND_ON_MAP, text)))
        return events


def _starts(patches: Mapping[int, Patch]) -> dict[int, ContactStart]:
    return {
        i: ContactStart((float(patch.centroid_m[0]), float(patch.centroid_m[1])), patch.radius_m)
        for i, patch in patches.items()
    }


def _estimated_friction(slips: Mapping[int, PartialSlip]) -> float | None:
    """Largest coefficient of those that are known well: too small a bound does far more harm than too large a one."""
    known = [
        slip.friction_coefficient
        for slip in slips.values()
        if slip.friction_coefficient_std < _FRICTION_KNOWN * slip.friction_coefficient
    ]
    return max(known, default=None)
