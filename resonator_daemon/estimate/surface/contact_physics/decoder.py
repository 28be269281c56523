"""Decoder with the physics of a contact: it is compact, it only pushes, and friction bounds its shear.

A linear decoder finds the support; inside it the traction is the least-squares one with f_z >= 0 and |f_t| <= mu f_z.
Without a support the same bounds would do harm: a carpet of small pushes would balance the load.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.base.arrays import Floats, Indices
from resonator_daemon.base.reasons import Reason, ReasonCode, joined
from resonator_daemon.estimate.surface.contact_physics.hypothesis import (
    UNKNOWN_FRICTION,
    Bounds,
    Hypothesis,
    Solved,
    examine,
    solve,
)
from resonator_daemon.estimate.surface.contact_physics.pixels import SurfaceView
from resonator_daemon.estimate.surface.contact_physics.support_problem import project_on_cone
from resonator_daemon.estimate.surface.contact_physics.support_search import Frame, Located, SupportSearch, load_support
from resonator_daemon.estimate.surface.decoded import Decoded, stated
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.estimate.surface.open_plane.linear_map import Estimate
from resonator_daemon.estimate.surface.patches import NetLoad

_ESTIMATE_MARGIN = 1.4  # too small a coefficient does far more harm than too large a one
_SIGNIFICANT = 5.0  # standard deviations of the peak of pressure
_COLD = 12  # iterations
_WARM = 1  # iterations, and ...
_WARM_MOST = 6  # ... how many where they are needed to explain the signals
_MOVED = 1.5  # pixels, after which `rebuild` follows
# Terms of the traction's standard deviation, tuned to closed-form contacts.
_STD_FACTOR = 0.75  # of the iteration's own standard deviation
_SHAPE_ERROR = np.array([0.034, 0.034, 0.025], np.float32)  # of the local traction: error of pixels and smoothness
_RIM_ERROR = 0.02  # of the peak traction, f_z only: error at the rim of a contact
_KNOWN_FRICTION = 0.9  # factor of all three where the friction coefficient is known
_PREPARING = Reason(
    ReasonCode.MATRICES_PENDING,
    "matrices of the contact are being prepared; the linear map cut to support and cone is shown",
)
_RETRY_FRAMES = 100  # after which bounds that were given up are tried again


@dataclass(frozen=True)
class _Request:
    """What `rebuild` is to do."""

    frame: Frame
    hypothesis: Hypothesis  # to renew
    suspect: bool  # the frame contradicts it
    before: Solved | None  # what the frame, or the one before, led to


@dataclass(frozen=True)
class _Found:
    """What `rebuild` did."""

    request: _Request
    hypothesis: Hypothesis
    solved: Solved | None  # None where the frames that follow have one to begin with


class ContactDecoder:
    """Decoder of compact contacts that push, under Coulomb's law; about half the error of the linear map.

    Frames are decoded in the order of time: each starts from the result of the one before, until `reset`.

    Parameters
    ----------
    linear_decoder
        As `OpenPlaneDecoder`. Its queries must cover where contacts are looked for; by default they are the sites.
    friction_coefficient
        Of Coulomb's law, above 0; None where it is not known.
    background
        False: matrices for a new support are computed inside `decode`, which then takes some tens of milliseconds, and
        results are reproducible. True: `decode` never waits for them; it shows the linear map cut to support and cone
        until the caller has called `rebuild`.

    Attributes
    ----------
    friction_estimate
        Best estimate so far of a coefficient that is not known; the bound is 1.4 times that. None: no estimate.

    Raises
    ------
    ValueError
        A friction coefficient that is not finite and above 0; queries that do not span an area.
    """

    def __init__(
        self, linear_decoder: OpenPlaneDecoder, friction_coefficient: float | None = None, *, background: bool = False
    ) -> None:
        if friction_coefficient is not None and not 0.0 < friction_coefficient < np.inf:
            raise ValueError(f"friction_coefficient is {friction_coefficient}, must be finite and above 0")
        if not isinstance(linear_decoder, OpenPlaneDecoder):
            raise ValueError(f"linear_decoder is a {type(linear_decoder).__name__}, must be an OpenPlaneDecoder")
        self._linear = linear_decoder
        self._given_friction = friction_coefficient
        self.friction_estimate: float | None = None
        self._background = background
        self._search = SupportSearch(linear_decoder)
        self._nearest = self._search.places.nearest
        self._count = len(linear_decoder.site_positions_m)
        self.reset()

    def reset(self) -> None:
        """Discard the frames before: the next one starts cold."""
        self._search.discard_rows()
        self._wanted: _Request | None = None
        self._found: deque[_Found] = deque(maxlen=1)
        self._hypothesis = self._fresh(None)
        self._release()

    def decode(self, signals: ArrayLike, *, displacement: bool = False) -> Decoded:
        """Return tractions, and displacements if asked for, of frames of signals [3 p_n / (2 E), eps_xz, eps_yz].

        Parameters
        ----------
        signals
            Shape (..., 3, n), or (..., 3, ny, nx) for a grid; dimensionless; the leading axis is time.
        displacement
            Also the surface displacement that the traction shown causes, alone on the plane.

        Returns
        -------
        Decoded
            Of the linear decoder's shape. `chi2`: mean square of what the traction leaves of the signals, in units of
            the noise. `status`: besides the linear decoder's, "constraint_dropped" where the signals contradict the
            bounds; `reason` names them, and what is shown.

        Raises
        ------
        ValueError
            Signals of another shape, or not numbers.
        """
        frames = np.asarray(signals, np.float64)
        axes = 2 if frames.shape[-2:] == (3, self._count) else 3
        leading = frames.shape[:-axes]
        if not frames.size:
            return self._linear.decode(frames, displacement=displacement)  # which checks shapes
        decoded = [self._decode(frame, displacement) for frame in frames.reshape(-1, *frames.shape[-axes:])]
        return Decoded.stack(decoded, leading, decoded[0].traction_pascal.shape) if leading else decoded[0]

    def net_loads(self, contacts: Sequence[Indices]) -> list[NetLoad | None]:
        """Return force, and moment about the origin, of contacts in the frame decoded last.

        They are sums of the traction without bounds, which have no bias. Load that is connected with places of several
        contacts counts for the nearest of them. None if the frame shows no constrained contact at those places.

        Parameters
        ----------
        contacts
            Indices of some places of each contact, (k,).
        """
        if self._last is None:
            return [None] * len(contacts)
        frame, located = self._last.frame, self._last.located
        pixels = [self._nearest.take(places) for places in contacts]
        noise_std = frame.noise_std / located.problem.model.noise_std
        return located.sums.loads(pixels, self._last.right_side, noise_std)

    def rebuild(self, pause: Callable[[], None] = lambda: None) -> bool:
        """Compute the matrices that the newest frame asked for; return whether one did.

        `pause` is called between parts, which take about 2 ms each. It may decode frames, and may reset this decoder.
        """
        request, self._wanted = self._wanted, None
        if request is None:
            return False
        hypothesis, found = request.hypothesis, self._found  # which a reset between parts replaces
        located = self._search.locate(request.frame, hypothesis.missed, hypothesis.located, pause)
        renewed = replace(hypothesis, located=located)
        solved: Solved | None = None
        if request.suspect:
            renewed, solved = examine(self._search, request.frame, renewed, self._friction, request.before, pause)
        elif request.before is None:
            pause()
            solved = solve(request.frame, located, self._friction(renewed.bounds), None, _COLD)
        found.append(_Found(request, renewed, solved))
        return True

    def _release(self) -> None:
        """Discard the contact, and what was found out about it."""
        self._last: Solved | None = None
        self._reconsider()

    def _reconsider(self) -> None:
        """Trust the linear map and the bounds again."""
        self._hypothesis = self._fresh(self._hypothesis.located)
        self._age = 0

    def _fresh(self, located: Located | None) -> Hypothesis:
        return Hypothesis(located, np.zeros(self._search.shape, np.bool_))

    def _decode(self, signals: Floats, displacement: bool) -> Decoded:
        estimate = self._linear.estimate(signals)
        surface = estimate.surface
        if surface is None or not surface.significance >= _SIGNIFICANT:  # no load that is a contact
            self._release()
            return estimate.decoded(displacement)
        self._age += 1
        if self._age > _RETRY_FRAMES:
            self._reconsider()
        self._adopt()
        if not self._is_dropped():
            frame = self._search.frame(estimate, surface)
            self._last = self._solve(frame)
            if self._last is not None:
                return self._shown(self._last, estimate, displacement)
            if not self._is_dropped():
                return self._masked(estimate, frame, displacement)
        self._last = None
        linear = estimate.decoded(displacement)
        return _explained(replace(linear, status="constraint_dropped"), self._hypothesis.reason)

    def _is_dropped(self) -> bool:
        return self._hypothesis.bounds == "none"

    def _friction(self, bounds: Bounds) -> float:
        bound = self._given_friction
        if bound is None and self.friction_estimate is not None:
            bound = _ESTIMATE_MARGIN * self.friction_estimate
        return UNKNOWN_FRICTION if bound is None or bounds != "all" else min(bound, UNKNOWN_FRICTION)

    def _adopt(self) -> None:
        """Adopt what `rebuild` has found."""
        if not self._found:
            return
        found = self._found.pop()
        if found.request.hypothesis is not self._hypothesis:  # it was discarded meanwhile
            self._hypothesis = replace(self._hypothesis, located=found.hypothesis.located)
            return
        if found.hypothesis.bounds != self._hypothesis.bounds:
            self._age = 0
        self._hypothesis = found.hypothesis
        if found.request.suspect or self._last is None:
            self._last = found.solved

    def _solve(self, frame: Frame) -> Solved | None:
        """Return the traction of a frame; None while there are no matrices for it, or when all bounds are given up."""
        located = self._hypothesis.located
        fit = "unfit" if located is None else self._search.fit(located, frame)
        if self._background:
            due = located is None or fit != "good" or np.hypot(*located.moved(frame)) > _MOVED
            before = self._last if fit != "unfit" else None
            self._wanted = _Request(frame, self._hypothesis, False, before) if due else None
            if fit == "unfit":
                return None
        elif fit != "good":
            located = self._search.locate(frame, self._hypothesis.missed, located)
            self._hypothesis = replace(self._hypothesis, located=located)
        if located is None:
            return None
        friction = self._friction(self._hypothesis.bounds)
        if self._last is None:
            solved = solve(frame, located, friction, None, _COLD)
        else:
            solved = solve(frame, located, friction, self._last, _WARM, _WARM_MOST)
        if solved.is_sound:
            return solved
        if self._background:
            self._wanted = _Request(frame, self._hypothesis, True, solved)
            return solved
        bounds = self._hypothesis.bounds
        self._hypothesis, examined = examine(self._search, frame, self._hypothesis, self._friction, solved)
        if self._hypothesis.bounds != bounds:
            self._age = 0
        return examined

    def _masked(self, estimate: Estimate, frame: Frame, displacement: bool) -> Decoded:
        """Linear map cut to support and cone, while there are no matrices."""
        friction, support = self._friction(self._hypothesis.bounds), load_support(frame.pressure).ravel()
        linear = estimate.decoded(displacement=False)
        places = project_on_cone(linear.traction_pascal.reshape(3, -1).astype(np.float32), friction)
        displaced = None
        if displacement:
            pixels = np.flatnonzero(support)
            on_pixels = project_on_cone(frame.traction[:, pixels], friction)
            displaced = SurfaceView(self._search.places, pixels).displacement(on_pixels).reshape(estimate.shape)
        masked = replace(
            linear,
            traction_pascal=(places * support[self._nearest]).astype(np.float64).reshape(estimate.shape),
            displacement_m=displaced,
        )
        return _explained(masked, joined(_PREPARING, estimate.reason))

    def _shown(self, solved: Solved, estimate: Estimate, displacement: bool) -> Decoded:
        """Return the traction found in the form of the linear decoder."""
        located, view, shape = solved.located, solved.located.view, estimate.shape
        noise_std = solved.frame.noise_std / located.problem.model.noise_std
        is_known = self._friction(self._hypothesis.bounds) < UNKNOWN_FRICTION
        factor = _KNOWN_FRICTION if is_known else 1.0
        size = np.linalg.norm(solved.traction, axis=0)
        shape_error = np.outer(_SHAPE_ERROR, size)
        shape_error[2] = np.hypot(shape_error[2], _RIM_ERROR * size.max(initial=0.0))
        pixel_std = factor * np.hypot(_STD_FACTOR * noise_std * located.std_pascal, shape_error)
        std = solved.frame.surface.std()
        loaded = solved.inside[view.nearest]
        std[:, view.covered[loaded]] = pixel_std[:, view.nearest[loaded]]
        text, code = stated(joined(self._hypothesis.reason, estimate.reason))
        return Decoded(
            traction_pascal=view.traction(solved.traction).reshape(shape),
            traction_std_pascal=std.reshape(shape),
            displacement_m=view.displacement(solved.traction).reshape(shape) if displacement else None,
            border_contact=solved.frame.surface.reaches_border,
            log_evidence=estimate.log_evidence,
            chi2=solved.chi2,
            status="ok" if self._hypothesis.bounds == "all" else "constraint_dropped",
            reason=text,
            reason_code=code,
        )


def _explained(frame: Decoded, reason: Reason | None) -> Decoded:
    text, code = stated(reason)
    return replace(frame, reason=text, reason_code=code)
