"""Decoder that knows what a contact is: it is compact, it only pushes, and friction bounds its shear.

A linear decoder finds the support; inside it the traction is the least-squares one with f_z >= 0 and |f_t| <= mu f_z.
Without a support the same bounds would do harm: a carpet of small pushes would balance the load.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from resonator_daemon.decoding.cone_admm import project_on_cone
from resonator_daemon.decoding.decoded import Decoded
from resonator_daemon.decoding.net_load import NetLoad, net_load
from resonator_daemon.decoding.pixels import PixelLattice
from resonator_daemon.decoding.support import BLOB_PEAK, connected, load_support, raw_support
from resonator_daemon.decoding.support_search import Frame, LinearDecoder, Located, SupportSearch

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Mask = NDArray[np.bool_]

UNKNOWN_FRICTION = 3.0  # a coefficient that no dry contact reaches
_ESTIMATE_MARGIN = 1.4  # too small a coefficient does far more harm than too large a one
_SIGNIFICANT = 5.0  # standard deviations of the peak of pressure
_COLD, _WARM, _CONVERGED = 12, 2, 60  # iterations
_STEPS = 4  # of finding out why a solution does not explain the signals
_BOUNDS_COST = 0.1  # in chi2: what bounds that hold never cost
_STD_FACTOR = 0.8  # of the iteration's own standard deviation ...
_SHAPE_ERROR = 0.03  # ... and of the traction, by pixels and smoothness: both to fit closed-form contacts
_RETRY_FRAMES = 100  # after which bounds that were given up are tried again

Bounds = Literal["all", "cone", "none"]  # kept: all; a cone of unknown friction; none


@dataclass(frozen=True)
class _Solved:
    """What one frame's iterations led to, on the n pixels of its problem."""

    frame: Frame
    located: Located
    inside: Mask  # pixels that may carry load, (n,)
    traction: Singles  # (3, n)
    multiplier: Singles
    chi2: float

    def on(self, located: Located) -> tuple[Singles, Singles]:
        """Traction and multiplier on the pixels of another problem."""
        if located is self.located:
            return self.traction, self.multiplier
        whole = np.zeros((2, 3, located.solved.size), np.float32)
        whole[..., self.located.problem.pixels] = self.traction, self.multiplier
        return tuple(whole[..., located.problem.pixels])


class ContactDecoder:
    """Tractions of compact contacts that push and obey Coulomb's law, about half the error of the linear map.

    Frames are taken in the order of time: each begins where the one before ended; `reset` forgets.

    Parameters
    ----------
    linear_decoder
        As `OpenPlaneDecoder`. Its queries must cover where contacts are looked for; by default they are the sites.
    friction_coefficient
        Of Coulomb's law, above 0; None where it is not known.
    background
        False: matrices for a new support are computed inside `decode`, which then takes some tens of milliseconds, and
        results are reproducible. True: `decode` never waits for them; it shows the linear map cut to support and cone
        until another thread, which the caller owns, has called `rebuild`.

    Raises
    ------
    ValueError
        A friction coefficient that is not finite and above 0; queries that do not span an area.
    """

    def __init__(
        self, linear_decoder: LinearDecoder, friction_coefficient: float | None = None, *, background: bool = False
    ) -> None:
        if friction_coefficient is not None:
            _refuse_friction("friction_coefficient", friction_coefficient)
        self._linear = linear_decoder
        self._told_friction = friction_coefficient
        self._friction_estimate: float | None = None
        self._background = background
        sites, places = linear_decoder.site_positions_m, linear_decoder.query_positions_m
        self._lattice = PixelLattice.over(sites, float(np.median(linear_decoder.depths_m)))
        self._to_places = self._lattice.to_places(places)
        self._nearest = self._lattice.nearest(places)
        self._search = SupportSearch(linear_decoder, self._lattice)
        self._count = len(sites)
        self.reset()

    def reset(self) -> None:
        """Forget the frames before: the next one starts cold."""
        self._wanted: Frame | None = None
        self._located: Located | None = None
        self._release()

    @property
    def friction_estimate(self) -> float | None:
        """Best estimate so far of a coefficient that was not told; the bound is 1.4 times that. None: not known."""
        return self._friction_estimate

    @friction_estimate.setter
    def friction_estimate(self, estimate: float | None) -> None:
        if estimate is not None:
            _refuse_friction("friction_estimate", estimate)
        self._friction_estimate = estimate

    def decode(self, signals: ArrayLike, *, displacement: bool = False) -> Decoded:
        """Tractions, and displacements where asked for, of frames of signals [3 p_n / (2 E), eps_xz, eps_yz].

        Parameters
        ----------
        signals
            Shape (..., 3, n), or (..., 3, ny, nx) for a grid; dimensionless; the leading axis is time.
        displacement
            Also the surface displacement, of the linear map.

        Returns
        -------
        Decoded
            Of the linear decoder's shape. `chi2`: mean square of what the traction leaves of the signals, in units of
            the noise. `status`: beside the linear decoder's, "constraint_dropped" where the signals contradict the
            bounds; `reason` says which ones, and what is shown.

        Raises
        ------
        ValueError
            Signals of another shape, or not numbers.
        """
        frames = np.asarray(signals, np.float64)
        axes = 2 if frames.shape[-2:] == (3, self._count) else 3
        leading = frames.shape[:-axes]
        decoded = [self._decode(frame, displacement) for frame in frames.reshape(-1, *frames.shape[-axes:])]
        return Decoded.stack(decoded, leading, decoded[0].traction_pascal.shape) if leading else decoded[0]

    def net_load(self, places: Mask, about_m: tuple[float, float]) -> NetLoad | None:
        """Force and moment of the contacts that touch some of the places, (m,) or (ny, nx), in the frame decoded last.

        From the traction without bounds, whose sums have no bias. None where that frame shows no constrained contact.
        """
        if self._last is None:
            return None
        problem, inside = self._last.located.problem, self._last.inside
        seed, support = np.zeros((2, *self._lattice.shape), np.bool_)
        seed.ravel()[self._nearest[np.flatnonzero(places)]] = True
        support.ravel()[problem.pixels[inside]] = True
        chosen = connected(support, seed).ravel()[problem.pixels]
        arms_m = self._lattice.centres_m[problem.pixels] - about_m
        noise_std = self._last.frame.noise_std / problem.noise_std
        return net_load(problem, self._last.frame.rows, inside, chosen, arms_m, self._lattice.pitch_m**2, noise_std)

    @property
    def rebuild_wanted(self) -> bool:
        """Whether `rebuild` has something to do."""
        return self._wanted is not None

    def rebuild(self) -> bool:
        """Compute the matrices that the newest frame asked for, if any did; may run in a thread of its own."""
        frame, self._wanted = self._wanted, None
        if frame is None:
            return False
        self._rebuilt(frame)
        return True

    def _release(self) -> None:
        """Forget the contact, and what was found out about it."""
        self._last: _Solved | None = None
        self._reconsider()

    def _reconsider(self) -> None:
        """Trust the support and the bounds again."""
        self._missed = np.zeros(self._lattice.shape, np.bool_)
        self._bounds: Bounds = "all"
        self._reason = ""
        self._age = 0

    def _decode(self, signals: Floats, displacement: bool) -> Decoded:
        linear = self._linear.decode(signals, displacement=displacement)
        if linear.status != "ok":
            self._release()
            return linear
        places = linear.traction_pascal.reshape(3, -1)
        peak = int(np.argmax(places[2]))
        if places[2, peak] < _SIGNIFICANT * linear.traction_std_pascal.reshape(3, -1)[2, peak]:
            self._release()
            return linear
        self._age += 1
        if self._age > _RETRY_FRAMES:
            self._reconsider()
        if self._bounds != "none":
            frame = self._search.frame(signals, linear)
            located = self._ready(frame)
            if located is None:
                self._last = None
                return self._masked(linear, frame)
            self._last = self._solve(frame, located, linear, _COLD if self._last is None else _WARM)
            if self._last.chi2 > frame.chi2_limit + located.model_chi2(frame):
                self._last = self._examine(self._last, linear)
            if self._last is not None:
                return self._shown(self._last, linear)
        return replace(linear, status="constraint_dropped", reason=self._reason)

    def _friction(self) -> float:
        told = self._told_friction
        if told is None and self._friction_estimate is not None:
            told = _ESTIMATE_MARGIN * self._friction_estimate
        return UNKNOWN_FRICTION if told is None or self._bounds != "all" else min(told, UNKNOWN_FRICTION)

    def _ready(self, frame: Frame) -> Located | None:
        """Matrices that serve this frame; asks for new ones before a moving contact leaves them."""
        located = self._located
        support = raw_support(frame.pressure)
        serves = located is not None and self._search.fits(located, frame, support)
        if located is not None and serves:
            if not (support & ~located.nearby).any():
                return located
            needed = load_support(frame.pressure)
            if not (needed & ~located.nearby).any():
                return located
            serves = not (
                frame.pressure[needed & ~(located.solved | located.nearby)] > BLOB_PEAK * frame.pressure.max()
            ).any()
        if not self._background:
            return self._rebuilt(frame)
        self._wanted = frame
        return located if serves else None

    def _rebuilt(self, frame: Frame) -> Located:
        self._located = self._search.locate(frame, self._missed)
        return self._located

    def _solve(self, frame: Frame, located: Located, linear: Decoded, iterations: int) -> _Solved:
        """Traction in the friction cone, from where the frame before ended."""
        problem, friction = located.problem, self._friction()
        inside = located.allowed(raw_support(frame.pressure)).ravel()[problem.pixels]
        if self._last is None:
            traction = project_on_cone(self._search.on_pixels(linear)[:, problem.pixels], friction) * inside
            multiplier = np.zeros_like(traction)
        else:
            traction, multiplier = self._last.on(located)
        right_side = problem.right_side(frame.rows)
        traction, multiplier = problem.constrained(right_side, friction, inside, traction, multiplier, iterations)
        return _Solved(
            frame, located, inside, traction, multiplier, problem.chi2(frame.rows, traction) / frame.noise_floor
        )

    def _examine(self, solved: _Solved, linear: Decoded) -> _Solved | None:
        """Where too much is left of the signals: iterate, grow the support, give bounds up. None: all of them."""
        frame, located = solved.frame, solved.located
        for _ in range(_STEPS):
            self._last = solved = self._solve(frame, located, linear, _CONVERGED)
            by_pixels = located.model_chi2(frame)
            if solved.chi2 <= frame.chi2_limit + by_pixels:
                return solved
            problem = located.problem
            free = problem.linear(problem.right_side(frame.rows), solved.inside, solved.traction)
            chi2 = problem.chi2(frame.rows, free) / frame.noise_floor
            if chi2 > frame.chi2_limit + by_pixels:
                self._missed = self._missed | self._search.missed_load(frame, problem, free)
                if not (self._missed & ~located.found).any():
                    break
                self._reason = "load beside the support, found in what that left of the signals"
                if self._background:
                    self._wanted = frame
                    return solved
                located = self._rebuilt(frame)
            elif solved.chi2 <= chi2 + _BOUNDS_COST * frame.excess + by_pixels:
                return solved
            elif self._bounds == "all" and self._friction() < UNKNOWN_FRICTION:
                what = f"friction coefficient {self._friction():.3g} contradicted"
                self._give_up("cone", f"{what}, chi2 {solved.chi2:.3g} for {chi2:.3g}; bound by {UNKNOWN_FRICTION:.0f}")
            else:
                what = f"a load that only presses contradicted, chi2 {solved.chi2:.3g} for {chi2:.3g}"
                self._give_up("none", f"{what}; the linear map is shown")
                return None
        self._give_up("none", f"no load on the support explains the signals, chi2 {chi2:.3g}; the linear map is shown")
        return None

    def _give_up(self, bounds: Bounds, reason: str) -> None:
        self._bounds, self._reason, self._age = bounds, reason, 0

    def _masked(self, linear: Decoded, frame: Frame) -> Decoded:
        """Linear map cut to support and cone, while there are no matrices."""
        places = linear.traction_pascal.reshape(3, -1).astype(np.float32)
        keep = load_support(frame.pressure).ravel()[self._nearest]
        traction = project_on_cone(places, self._friction()) * keep
        return replace(linear, traction_pascal=traction.astype(np.float64).reshape(linear.traction_pascal.shape))

    def _shown(self, solved: _Solved, linear: Decoded) -> Decoded:
        """As the linear decoder would return it, of the traction found."""
        problem, shape = solved.located.problem, linear.traction_pascal.shape
        noise_std = solved.frame.noise_std / problem.noise_std
        size = np.sqrt(np.sum(solved.traction**2, axis=0))
        whole = np.zeros((2, 3, solved.located.solved.size), np.float32)
        whole[0][:, problem.pixels] = solved.traction
        whole[1][:, problem.pixels] = solved.inside * np.hypot(
            _STD_FACTOR * noise_std * solved.located.std_pascal, _SHAPE_ERROR * size
        )
        traction = (self._to_places @ whole[0].T).T.astype(np.float64)
        std = whole[1][:, self._nearest]
        std = np.where(std > 0.0, std, linear.traction_std_pascal.reshape(3, -1))
        return replace(
            linear,
            traction_pascal=traction.reshape(shape),
            traction_std_pascal=std.reshape(shape),
            chi2=solved.chi2,
            status="ok" if self._bounds == "all" else "constraint_dropped",
            reason="; ".join(filter(None, [str(linear.reason), self._reason])),
        )


def _refuse_friction(name: str, value: float) -> None:
    if not 0.0 < value < np.inf:
        raise ValueError(f"{name} is {value}, must be finite and above 0")
