"""From a frame and its linear map to the inverse problem on a support."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy import ndimage

from resonator_daemon.base.arrays import Bools, Floats, Labels, Singles
from resonator_daemon.estimate.surface.contact_physics.net_load import LoadSums
from resonator_daemon.estimate.surface.contact_physics.pixels import (
    Interpolation,
    PixelLattice,
    PixelPrior,
    SurfacePlaces,
    SurfaceView,
)
from resonator_daemon.estimate.surface.contact_physics.signal_rows import LostRows, SignalRows, site_kernel
from resonator_daemon.estimate.surface.contact_physics.support_problem import SupportProblem
from resonator_daemon.estimate.surface.contact_physics.support_rows import Model, SupportRows
from resonator_daemon.estimate.surface.decoded import GAIN_FLOOR
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.estimate.surface.open_plane.linear_map import Estimate
from resonator_daemon.estimate.surface.open_plane.modes import Surface

_PRIOR_VARIANCE = 0.24  # of f_z in the support, over the linear map's mean square ...
_PRIOR_SNR = 8.0  # ... at low ratios of signal to noise; half at this one, because contacts are smooth
_LEAD = 0.9  # of what a contact moved between two problems: how far the solved support goes ahead of it ...
_MOST_LEAD = 3.0  # ... in pixels
_FLICKER = 0.05  # of the solved support: how much of a load's may lie outside it before matrices are due
_FARTHEST = 4.0  # pixels of such a move; more is another contact
_REACH = 8  # pixels beyond the linear map in which a contact at its border is looked for
_MISSED_REACH = 6  # pixels around the place of a missed load that may carry it
_LIGHT = 0.2  # of such a load's peak: what belongs to it
_CHI2_SIGMAS = 4.0
_MODEL_ERROR = 0.19  # of the signals, by a traction that is even over each pixel, times pixels in a contact ...
_MODEL_EXPONENT = -0.75  # ... to this power
_NOTICED = 6.0  # standard deviations by which a pressure that was missed shows
_CLOSE = 0.6  # of its peak: where it may be
_DRIFT = 1.3  # factor by which the prior's standard deviation over the noise's may change before matrices are due ...
_STALE = 2.0  # ... until which the old ones serve ...
_KEPT = 1.15  # ... and until which new matrices keep the old prior and noise
_RHO = 6.0  # of the method of multipliers, over the inverse prior variance of f_z
_TINY = 1e-30


Fit = Literal["good", "due", "unfit"]  # of a problem for a frame: due, serves but should be followed by another

_THRESHOLD = 0.15  # of the largest pressure: what belongs to a contact
BLOB_PEAK = 0.25  # of the largest pressure: what a blob must reach to count as one
_BLOB_PIXELS = 2

_EIGHT = np.ones((3, 3), np.bool_)


@dataclass(frozen=True)
class Frame:
    """One frame's signals and its linear map, on the pixels 0 where that does not reach."""

    rows: Singles  # of the whitened signals
    known: Bools | None  # (3 n,), None where all are
    surface: Surface
    to_pixels: Interpolation  # from the surface's places
    pressure: Singles  # on the pixels, (ny, nx)
    support: Bools  # where load may be by its pressure, a rough estimate, (ny, nx)
    centre: Floats  # of that pressure, in pixels (y, x)
    noise_floor: float  # noise variance that is reckoned with, over the declared one
    excess: float  # of the linear map's residual over that, at least 1
    snr: float  # of amplitudes
    chi2_limit: float  # what a load of the right support and bounds leaves of the rows, at most
    row_share: float  # of rows in signals

    @cached_property
    def traction(self) -> Singles:
        """Linear map on the pixels, (3, ny nx)."""
        return self.to_pixels(self.surface.traction.reshape(3, -1))

    @property
    def noise_std(self) -> float:
        """Of the rows' noise and of what the linear map's residual adds to it."""
        return math.sqrt(self.noise_floor * self.excess)


@dataclass(frozen=True)
class Located:
    """A support and the inverse problem on it and some pixels around."""

    found: Bools  # all masks (ny, nx)
    lasting: Bools  # part of it that the linear map cannot show
    solved: Bools  # pixels of the problem
    centre: Floats  # of the frame that it was made for
    problem: SupportProblem
    sums: LoadSums
    view: SurfaceView
    std_pascal: Singles  # of the problem's pixels, (3, n)
    level: float  # prior standard deviation that the linear map gave, over the noise's
    model_error: float  # of the pixels, over the signals

    def model_chi2(self, frame: Frame) -> float:
        """Return the mean square residual that the pixels' error adds."""
        return (self.model_error * frame.snr) ** 2 / frame.row_share

    def inside(self, frame: Frame) -> Bools:
        """Return which of the problem's pixels may carry load in a frame, (n,)."""
        return (frame.support | self.lasting).ravel()[self.problem.pixels]

    def moved(self, frame: Frame) -> Floats:
        """Return the pixels (y, x) by which the load has moved since; 0 where it must be another one."""
        steps = frame.centre - self.centre
        return steps if np.hypot(*steps) < _FARTHEST else np.zeros(2)


class SupportSearch:
    """Builder of the inverse problems of one skin.

    Parameters
    ----------
    linear
    """

    def __init__(self, linear: OpenPlaneDecoder) -> None:
        sites, positions_m = linear.site_positions_m, linear.query_positions_m
        lattice = PixelLattice.over(sites, float(np.median(linear.depths_m)))
        noise_std = np.broadcast_to(linear.noise_std, (3, len(sites)))
        self._rows = SignalRows(site_kernel(linear.half_space, sites, linear.depths_m, noise_std, lattice))
        self._gain_floor = (GAIN_FLOOR * linear.gain_std) ** 2
        self._prior = PixelPrior(lattice, linear.prior.correlation_length_m)
        self._tangential_ratio = linear.prior.tangential_ratio
        self._lattice = lattice
        self._centres_m = lattice.centres_m
        self.places = SurfacePlaces(linear.half_space, lattice, positions_m)
        self.shape = lattice.shape
        self._from_places = lattice.from_places(positions_m)
        self._unmapped = ~self._from_places.reached.reshape(lattice.shape)
        self._mapped = ~self._unmapped
        self._edge = dilated(self._unmapped) & ~self._unmapped
        self._pressure_power = np.einsum("pr,pr->p", self._rows.kernel[2], self._rows.kernel[2])
        ny, nx = (np.arange(count, dtype=np.float32) for count in lattice.shape)
        self._moments = np.stack([np.ones_like(ny), ny]), np.stack([np.ones_like(nx), nx], axis=1)
        self._lost: tuple[bytes, LostRows] | None = None
        self._newest_rows: SupportRows | None = None  # most pixels of a contact are those of the frame before

    def discard_rows(self) -> None:
        """Make the matrices of the next problem from nothing."""
        self._newest_rows = None

    def frame(self, estimate: Estimate, surface: Surface) -> Frame:
        """Frame of which the linear decoder made an estimate."""
        known, lost = estimate.known, None
        rows, count = self._rows.project(estimate.whitened), estimate.whitened.size
        if known is not None:
            lost, count = self._lost_rows(known), int(np.count_nonzero(known))
            rows = lost.signals(rows)
        power = estimate.energy / count
        floor = 1.0 + self._gain_floor * power
        pressure = self._from_places(surface.pressure).reshape(self._lattice.shape)
        support = raw_support(pressure)
        excess, snr = max(estimate.chi2, 1.0), max(power / floor - 1.0, 0.0) ** 0.5
        return Frame(
            rows,
            known,
            surface,
            self._from_places,
            pressure,
            support,
            self._centre(pressure * support),
            floor,
            excess,
            snr,
            excess * (1.0 + _CHI2_SIGMAS * (2.0 / rows.size) ** 0.5),
            rows.size / estimate.whitened.size,
        )

    def locate(
        self, frame: Frame, missed: Bools, before: Located | None, pause: Callable[[], None] = lambda: None
    ) -> Located:
        """Find the pixels that carry load, and build the problem on them.

        Beyond the linear map's reach, and around pixels where load was missed, they are read off the least-squares
        traction on all pixels there. Where the load has moved since the problem `before`, it is expected to move on.
        `pause`: see `ContactDecoder.rebuild`.
        """
        seen = load_support(frame.pressure)
        around = dilated(missed, _MISSED_REACH) & ~dilated(seen)
        wide = seen | around
        if (seen & self._edge).any():
            wide |= dilated(seen, _REACH) & self._unmapped
        found, grown = seen, np.zeros_like(seen)
        level = std_pascal = _prior_std_pascal(frame.pressure[seen & self._mapped], frame.snr)
        if (wide & ~seen).any():
            pressure = self._free_pressure(frame, wide, level, pause)
            found = load_support(pressure)
            if around.any():
                light = np.where(around, pressure, 0.0)
                grown = dilated(light > _LIGHT * light.max())
                found |= grown | seen
            else:
                std_pascal = _prior_std_pascal(pressure[found], frame.snr)
        solved = found
        if before is not None:
            solved = swept(found, np.clip(_LEAD * before.moved(frame), -_MOST_LEAD, _MOST_LEAD))
        level /= frame.noise_std
        noise_std = frame.noise_std
        previous = None if before is None else before.problem
        if before is not None and 1.0 / _KEPT < level / before.level < _KEPT:
            # Most matrices serve on where prior and noise stay as they were.
            level, std_pascal, noise_std = before.level, before.problem.model.std_pascal, before.problem.model.noise_std
        problem = self._problem(frame, solved, std_pascal, noise_std, previous, pause)
        pause()
        model_error = _MODEL_ERROR * (np.count_nonzero(found) / int(blobs(found).max())) ** _MODEL_EXPONENT
        lasting = found & self._unmapped | grown
        sums = LoadSums(problem, blobs(solved).ravel(), self._centres_m, self._lattice.pitch_m**2)
        pause()
        view = SurfaceView(self.places, problem.pixels)
        return Located(found, lasting, solved, frame.centre, problem, sums, view, problem.std(), level, model_error)

    def _free_pressure(self, frame: Frame, wide: Bools, std_pascal: float, pause: Callable[[], None]) -> Singles:
        """Return the least-squares f_z of a frame on many pixels, (ny, nx)."""
        problem = self._problem(frame, wide, std_pascal, frame.noise_std, None, pause)
        pause()
        count = problem.pixels.size
        start = np.zeros((3, count), np.float32)
        load = problem.linear(problem.right_side(frame.rows), np.ones(count, np.bool_), start)
        pressure = np.zeros(wide.size, np.float32)
        pressure[problem.pixels] = load[2]
        return pressure.reshape(wide.shape)

    def missed_load(self, frame: Frame, problem: SupportProblem, traction: Singles) -> Bools:
        """Return the pixels (ny, nx) whose pressure would best explain what a traction leaves of a frame's signals."""
        left = frame.rows - problem.predicted(traction)
        if problem.model.lost is not None:
            left = problem.model.lost.back(left)
        pressure = self._rows.kernel[2]
        score = (pressure @ left) / np.sqrt(self._pressure_power)
        score /= np.float32(frame.noise_std)
        best = float(score.max())
        if best < _NOTICED:
            return np.zeros(self._lattice.shape, np.bool_)
        return dilated((score > _CLOSE * best).reshape(self._lattice.shape))

    def fit(self, located: Located, frame: Frame) -> Fit:
        """Return whether a problem's prior, noise and lost signals do for a frame, and its pixels for the load."""
        prior_std_pascal = _prior_std_pascal(frame.pressure[frame.support & self._mapped], frame.snr)
        drift = prior_std_pascal / frame.noise_std / located.level
        lost = None if frame.known is None else self._lost_rows(frame.known)
        if located.problem.model.lost is not lost or not 1.0 / _STALE < drift < _STALE:
            return "unfit"
        most = _FLICKER * located.problem.pixels.size
        if np.count_nonzero(frame.support & ~located.solved) > most:
            outside = load_support(frame.pressure) & ~located.solved
            if np.count_nonzero(outside) > most:
                heavy = float(frame.pressure[outside].max()) > BLOB_PEAK * float(frame.pressure.max())
                return "unfit" if heavy else "due"
        return "good" if 1.0 / _DRIFT < drift < _DRIFT else "due"

    def _problem(
        self,
        frame: Frame,
        support: Bools,
        std_pascal: float,
        noise_std: float,
        before: SupportProblem | None,
        pause: Callable[[], None],
    ) -> SupportProblem:
        lost = None if frame.known is None else self._lost_rows(frame.known)
        model = Model(self._rows.kernel, self._prior, self._tangential_ratio, lost, std_pascal, noise_std, _RHO)
        problem = SupportProblem(model, support.ravel(), before, self._newest_rows, pause)
        self._newest_rows = problem.rows
        return problem

    def _centre(self, weight: Singles) -> Floats:
        """In pixels (y, x)."""
        (total, x), (y, _) = self._moments[0] @ weight @ self._moments[1]
        return np.array([y, x], np.float64) / max(float(total), _TINY)

    def _lost_rows(self, known: Bools) -> LostRows:
        key = known.tobytes()
        if self._lost is None or self._lost[0] != key:
            self._lost = key, self._rows.whitener(known)
        return self._lost[1]


def _prior_std_pascal(pressure: Singles, snr: float) -> float:
    return math.sqrt(_PRIOR_VARIANCE / (1.0 + snr / _PRIOR_SNR) * float(pressure @ pressure) / max(pressure.size, 1))


def raw_support(pressure: Floats | Singles) -> Bools:
    """Return the pixels above the threshold, (ny, nx), and their neighbours: quick, with every blob of noise."""
    return dilated(pressure > _THRESHOLD * pressure.max())


def load_support(pressure: Floats | Singles) -> Bools:
    """Return the pixels (ny, nx) that carry load: above the threshold, in significant blobs, and their neighbours."""
    above = pressure > _THRESHOLD * pressure.max()
    labels, count = ndimage.label(above, _EIGHT)
    peaks = np.zeros(count + 1, pressure.dtype)
    np.maximum.at(peaks, labels.ravel(), pressure.ravel())
    kept = (peaks >= BLOB_PEAK * pressure.max()) & (np.bincount(labels.ravel()) >= _BLOB_PIXELS)
    kept[0] = False
    return dilated(kept[labels])


def dilated(mask: Bools, times: int = 1) -> Bools:
    """With its eight neighbours, `times` over."""
    for _ in range(times):
        wide = mask.copy()
        wide[:, 1:] |= mask[:, :-1]
        wide[:, :-1] |= mask[:, 1:]
        mask = wide.copy()
        mask[1:] |= wide[:-1]
        mask[:-1] |= wide[1:]
    return mask


def swept(mask: Bools, steps: Floats) -> Bools:
    """With what it passes on its way by `steps` pixels (y, x)."""
    passed = mask.copy()
    count = int(np.rint(np.abs(steps).max()))
    for step in range(1, count + 1):
        dy, dx = (int(shift) for shift in np.rint(steps * step / count))
        passed[_part(dy), _part(dx)] |= mask[_part(-dy), _part(-dx)]
    return passed


def blobs(mask: Bools) -> Labels:
    """Return the number of the blob of each pixel (ny, nx), from 1, and 0 outside the mask."""
    return np.asarray(ndimage.label(mask, _EIGHT)[0], np.int32)


def _part(shift: int) -> slice:
    """Return what an axis that is shifted fills."""
    return slice(shift, None) if shift >= 0 else slice(None, shift)
