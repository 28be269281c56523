"""Parametric contact fit for sites too few or too far apart for a map: one contact of known profile in each frame."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.base.arrays import Bools, Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.decoded import (
    GAIN_FLOOR,
    KNOWN_LIMIT,
    SIGNAL_LIMIT,
    Decoded,
    check_gain,
    noise_of_signals,
    positions,
    stated,
)
from resonator_daemon.estimate.surface.fitting.contact_fit import CentreSearch, Fit, fit
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.layout import at_border, gap_m, refuse_duplicates
from resonator_daemon.estimate.surface.patches import Patch

FEWEST_SITES = 40  # with fewer, a linear map peaks at the nearest site
WIDEST_SPACING_DEPTHS = 3.0  # beyond it a contact between sites is felt by the nearest alone

# Unknowns are x, y, b = a^2, F_x, F_y, F_z: signals are nearly linear in b, and not in the radius a.
_UNKNOWNS = 6
_SQUARE = 2
_SHEAR = slice(3, 5)
_SMALLEST_RADIUS_DEPTHS = 0.05
_LARGEST_RADIUS_DEPTHS = 4.0
_REACH_DEPTHS = 2.0  # beyond the outermost sites, where a centre may lie
_FORCE_LIMIT = 100.0  # times the largest of the search
_CANDIDATES = 4
_SIGNIFICANT_FALL = 50.0  # of chi-square: less than one frame of noise in a million, wherever it may seem to press
_RIVAL_FALL = 9.0  # of chi-square: another contact that is worse by less explains the frame about as well ...
_RIVAL_STD = 4.0  # ... and is not meant by the error bars if it lies so many of them away
_STD_LIMIT_DEPTHS = 2.0  # of the centre: signals change over a depth, beyond it errors are not Gaussian
_CHI2_LIMIT = 10.0
_UNEXPLAINED_LIMIT = 0.2  # of the signals' energy
_USUAL_SHEAR = 0.3  # of the normal force, standard deviation of each component
_DRAWS = 64  # of the contact, for error bars: traction is too steep at the rim to be linear in the contact
_RIM_FACTOR = 1.2  # errors at the rim are not Gaussian: with it 92 % within two standard deviations


def sparse_reason(site_positions_m: ArrayLike, depth_m: float) -> str | None:
    """Return why a map would mislead for sites (n, 2) at a depth; None where it would not."""
    sites = np.asarray(site_positions_m, np.float64)
    if len(sites) < FEWEST_SITES:
        return f"parametric contact fit: {len(sites)} sites, a map needs at least {FEWEST_SITES}"
    spacing = gap_m(sites)
    if spacing > WIDEST_SPACING_DEPTHS * depth_m:
        apart = f"sites {spacing * 1e3:.3g} mm apart at a depth of {depth_m * 1e3:.3g} mm"
        return f"parametric contact fit: {apart}, a map needs at most {WIDEST_SPACING_DEPTHS:g} depths"
    return None


class ParametricDecoder:
    """Decoder that fits one contact to a frame: a disc with the profile of a Hertz pressure, for shear alike.

    Every centre is tried, its force by linear least squares; fits start from the best places.

    Parameters
    ----------
    half_space
    site_positions_m
        (n, 2).
    depth_m
        Of all sites; above 0.
    noise_std
        Standard deviation of the noise of the dimensionless signals, broadcastable to (3, n), or (3,).
    gain_std
        Relative standard deviation of the signals' gains: (1.5 gain_std rms)^2 is added to the noise variance, rms that
        of the frame's signals, and then (gain_std s)^2, s those of the contact found.
    query_positions_m
        Where the traction is asked for, (m, 2); by default at the sites.

    Raises
    ------
    ValueError
        A shape that does not fit, a parameter out of its range, two sites at the same place, or no more signals than
        unknowns: there are six, centre, radius and force.
    """

    def __init__(
        self,
        half_space: HalfSpace,
        site_positions_m: ArrayLike,
        depth_m: float,
        noise_std: ArrayLike,
        *,
        gain_std: float = 0.0,
        query_positions_m: ArrayLike | None = None,
    ) -> None:
        sites = positions("site_positions_m", site_positions_m)
        count = len(sites)
        check_gain(gain_std)
        self._model = DiscModel(half_space, sites, depth_m, _LARGEST_RADIUS_DEPTHS * depth_m)
        if 3 * count <= _UNKNOWNS:
            raise ValueError(f"{count} sites make {3 * count} signals, must be more than {_UNKNOWNS}, the unknowns")
        refuse_duplicates(sites, np.full(count, depth_m))
        places = sites if query_positions_m is None else positions("query_positions_m", query_positions_m)
        self.half_space = half_space
        self.site_positions_m = sites
        self.query_positions_m = places
        self.noise_std = noise_of_signals(noise_std, (count,))
        self.gain_std = gain_std
        self._noise = self.noise_std.ravel()
        lowest_m = self._model.lowest_m - _REACH_DEPTHS * depth_m
        highest_m = self._model.highest_m + _REACH_DEPTHS * depth_m
        self._lower = np.array([*lowest_m, (_SMALLEST_RADIUS_DEPTHS * depth_m) ** 2])
        self._upper = np.array([*highest_m, self._model.radius_max_m**2])
        self._search = CentreSearch(self._model, self._noise, lowest_m, highest_m)
        self._nearest = np.array([np.hypot(*(self._search.centres_m - place).T).argmin() for place in places])
        self._why = sparse_reason(sites, depth_m) or f"parametric contact fit: {count} sites"
        self._draws = np.random.default_rng(0).standard_normal((_DRAWS // 2, _UNKNOWNS))

    def decode(self, signals: ArrayLike, *, displacement: bool = False) -> tuple[Decoded, Patch | None]:
        """Decode one frame of signals [3 p_n / (2 E), eps_xz, eps_yz]; return its contact, too.

        Parameters
        ----------
        signals
            Shape (3, n); dimensionless. A signal that is NaN, infinite or beyond 10 counts as lost.
        displacement
            Also the surface displacement that the contact causes, alone on the plane.

        Returns
        -------
        Decoded
            Of shape (3, m). `traction_std_pascal` is that of the one contact sought; where none shows, that of a
            contact which is as small as 0.7 depths and at that very place. `status`: "ok"; "no_signal", less than half
            of the signals known; "rejected", no single contact makes such signals; "ambiguous", two places explain them
            about equally well. `reason` always begins with why there is no map.
        Patch
            None where there is no contact or it is not known. Area and radius are those of the disc, not of a blurred
            map; its border flag is set if the centre lies among the outermost sites or beyond them.

        Raises
        ------
        ValueError
            Signals of another shape, or not numbers.
        """
        given = np.asarray(signals, np.float64)
        if given.shape != self.noise_std.shape:
            raise ValueError(f"signals have shape {given.shape}, must be {self.noise_std.shape}")
        frame = given.ravel()
        known = np.abs(frame) <= SIGNAL_LIMIT  # False for NaN
        needed = max(KNOWN_LIMIT * known.size, _UNKNOWNS + 1)
        if known.sum() < needed:
            reason = f"{known.sum()} signals known (finite, within {SIGNAL_LIMIT}), needs {needed:.0f}"
            return self._unknown(displacement, np.nan, np.nan, "no_signal", ReasonCode.SIGNALS_MISSING, reason), None
        rms = float(np.sqrt(np.mean(frame[known] ** 2)))
        noise = np.hypot(self._noise, GAIN_FLOOR * self.gain_std * rms)
        signals = np.where(known, frame, np.nan)
        fits = self._fits(signals, known, noise)
        quiet = float(np.sum((frame[known] / noise[known]) ** 2))
        best = fits[0] if fits else None
        if best and best.chi2 > _CHI2_LIMIT and best.unexplained > _UNEXPLAINED_LIMIT:
            reason = f"{best.unexplained:.0%} of the signals' energy fits no single contact, chi2 {best.chi2:.3g}"
            evidence = _log_density(best, noise[known])
            return self._unknown(displacement, evidence, best.chi2, "rejected", ReasonCode.FIT_REJECTED, reason), None
        if best is None or quiet - best.chi_square < _SIGNIFICANT_FALL * max(best.chi2, 1.0):
            nothing = Fit(np.empty(0), np.empty((0, 0)), quiet, int(known.sum()), quiet)
            return self._untouched(nothing, known, noise, displacement), None
        if self.gain_std:
            noise = np.hypot(self._noise, self.gain_std * self._signals(best.parameters)[0])
            best = self._refine(best.parameters, signals, noise)
        doubt = self._doubt(best, fits[1:])
        if doubt:
            evidence, code = _log_density(best, noise[known]), ReasonCode.PLACE_AMBIGUOUS
            return self._unknown(displacement, evidence, best.chi2, "ambiguous", code, doubt), None
        return self._describe(best, displacement, known, noise)

    def _fits(self, signals: Floats, known: Bools, noise: Floats) -> list[Fit]:
        """Return the contacts from the best places of the search, least chi-square first."""
        whitened = np.where(known, signals / self._noise, 0.0)
        places = self._search.candidates(whitened, known, _CANDIDATES)
        begins = [np.array([*place.centre_m, place.radius_m**2, *place.force_newton]) for place in places]
        return sorted((self._refine(begin, signals, noise) for begin in begins), key=lambda found: found.chi_square)

    def _refine(self, begin: Floats, signals: Floats, noise: Floats) -> Fit:
        limit = _FORCE_LIMIT * float(np.abs(begin[3:]).max())
        lower = np.array([*self._lower, -limit, -limit, 0.0])
        upper = np.array([*self._upper, limit, limit, limit])
        return fit(self._signals, begin, lower, upper, signals, noise)

    def _signals(self, contact: Floats) -> tuple[Floats, Floats]:
        """Return the signals (3 n,) of a contact, and their slopes (6, 3 n)."""
        radius_m = float(np.sqrt(contact[_SQUARE]))
        disc = self._model.signals(contact[:2], radius_m)
        force, columns = contact[3:], disc.value.reshape(3, -1)
        by_square = disc.by_radius / (2.0 * radius_m)
        moved = [force @ slope.reshape(3, -1) for slope in (disc.by_x, disc.by_y, by_square)]
        return force @ columns, np.vstack([*moved, columns])

    def _doubt(self, best: Fit, others: list[Fit]) -> str | None:
        """Return why the place is not known; None where it is."""
        x, y = 1e3 * best.parameters[:2]
        covariance = self._covariance(best)[:2, :2]
        std_m = float(np.sqrt(np.linalg.eigvalsh(covariance).max())) if np.isfinite(covariance).all() else np.inf
        if std_m > _STD_LIMIT_DEPTHS * self._model.depth_m:
            return f"the contact is near ({x:.1f}, {y:.1f}) mm or elsewhere: too few sites measure it"
        for other in others:
            apart = other.parameters[:2] - best.parameters[:2]
            near = apart @ np.linalg.solve(covariance, apart) < _RIVAL_STD**2
            if not near and other.chi_square - best.chi_square < _RIVAL_FALL * max(best.chi2, 1.0):
                other_x, other_y = 1e3 * other.parameters[:2]
                return f"contacts at ({x:.1f}, {y:.1f}) and ({other_x:.1f}, {other_y:.1f}) mm fit about equally well"
        return None

    def _covariance(self, found: Fit) -> Floats:
        """Of the contact, whose radius may be anything up to the largest one where it leaves no trace."""
        precision = found.precision.copy()
        precision[_SQUARE, _SQUARE] += 12.0 / self._model.radius_max_m**4
        return replace(found, precision=precision).covariance

    def _describe(self, found: Fit, displacement: bool, known: Bools, noise: Floats) -> tuple[Decoded, Patch]:
        contact, covariance = _with_shear_or_without(found.parameters, self._covariance(found))
        contact[:3] = np.clip(contact[:3], self._lower, self._upper)
        x, y = contact[:2]
        radius = float(np.sqrt(contact[_SQUARE]))
        force_x, force_y, force_z = force = contact[3:]
        offset = self.query_positions_m - contact[:2]
        traction = np.outer(force, hertz_traction(np.hypot(*offset.T), radius))
        std = np.sqrt(np.diag(covariance))
        border = bool(at_border(self.site_positions_m, contact[None, :2])[0])
        decoded = Decoded(
            traction_pascal=traction,
            traction_std_pascal=self._spread(contact, covariance, traction),
            displacement_m=self._displacement(contact) if displacement else None,
            border_contact=border,
            log_evidence=_log_density(found, noise[known]),
            chi2=found.chi2,
            status="ok",
            reason=self._why,
            reason_code=ReasonCode.CONTACT_FITTED,
        )
        by_contact = np.zeros((3, _UNKNOWNS))  # of the moments
        by_contact[0, [1, 5]] = force_z, y
        by_contact[1, [0, 5]] = -force_z, -x
        by_contact[2, [0, 1, 3, 4]] = force_y, -force_x, -y, x
        patch = Patch(
            centroid_m=contact[:2],
            centroid_std_m=std[:2],
            area_m2=float(np.pi * radius**2),
            force_newton=force,
            force_std_newton=std[3:],
            moment_newton_m=np.array([y * force_z, -x * force_z, x * force_y - y * force_x]),
            moment_std_newton_m=np.sqrt(np.diag(by_contact @ covariance @ by_contact.T)),
            at_border=border,
            places=np.flatnonzero(traction[2] > 0.0),
        )
        return decoded, patch

    def _spread(self, contact: Floats, covariance: Floats, traction: Floats) -> Floats:
        """Root mean square of what contacts drawn by the covariance do to the traction, (3, m)."""
        values, vectors = np.linalg.eigh(covariance)
        steps = self._draws @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
        drawn = contact + np.concatenate([steps, -steps])
        drawn[:, :3] = np.clip(drawn[:, :3], self._lower, self._upper)
        distance = np.hypot(*(self.query_positions_m[:, None] - drawn[:, :2]).transpose(2, 0, 1))
        shape = hertz_traction(distance, np.sqrt(drawn[:, _SQUARE]))  # (m, draws)
        off = drawn[:, 3:].T[:, None] * shape - traction[..., None]
        return np.asarray(_RIM_FACTOR * np.sqrt(np.mean(off**2, axis=-1)), np.float64)

    def _displacement(self, contact: Floats) -> Floats:
        offset = self.query_positions_m - contact[:2]
        per_newton = hertz_displacement(self.half_space, offset, float(np.sqrt(contact[_SQUARE])))
        return np.asarray(np.einsum("f,fcm->cm", contact[3:], per_newton), np.float64)

    def _untouched(self, nothing: Fit, known: Bools, noise: Floats, displacement: bool) -> Decoded:
        zero = np.zeros((3, len(self.query_positions_m)))
        smallest_m = float(self._search.radii_m[0])
        force_std = self._search.force_std_newton(known)[self._nearest].T
        std = force_std * np.sqrt(max(nothing.chi2, 1.0)) * hertz_traction(np.zeros(1), smallest_m)
        moved = np.zeros_like(zero) if displacement else None
        evidence = _log_density(nothing, noise[known])
        why = stated(Reason(ReasonCode.CONTACT_FITTED, f"{self._why}; no contact"))
        return Decoded(zero, std, moved, False, evidence, nothing.chi2, "ok", *why)

    def _unknown(
        self, displacement: bool, log_evidence: float, chi2: float, status: str, code: ReasonCode, text: str
    ) -> Decoded:
        shape = 3, len(self.query_positions_m)
        why = Reason(code, f"{self._why}; {text}")
        return Decoded.unknown(shape, displacement, log_evidence, chi2, status, why)


def _with_shear_or_without(contact: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Average over two hypotheses, weighed by their evidence: no shear at all, and shear as friction usually allows.

    Shear moves the signals much as a step aside does: without shear the error of the centre is half as large. The shear
    itself stays the second hypothesis' one, and so does its error.
    """
    none = np.zeros((2, 2))
    usual = (_USUAL_SHEAR * contact[5]) ** 2 * np.eye(2)
    still, still_covariance, still_evidence = _given_shear(contact, covariance, none)
    moved, moved_covariance, moved_evidence = _given_shear(contact, covariance, usual)
    weight = 1.0 / (1.0 + np.exp(np.clip(moved_evidence - still_evidence, -50.0, 50.0)))
    step = still - moved
    mean = moved + weight * step
    mean[_SHEAR] = moved[_SHEAR]
    spread = weight * still_covariance + (1.0 - weight) * moved_covariance
    spread += weight * (1.0 - weight) * np.outer(step, step)
    spread[_SHEAR, _SHEAR] += weight * moved_covariance[_SHEAR, _SHEAR]
    return mean, spread


def _given_shear(contact: Floats, covariance: Floats, prior: Floats) -> tuple[Floats, Floats, float]:
    """Return the contact, covariance and log evidence for shear drawn from a Gaussian around 0: the linear update."""
    shear, spread = contact[_SHEAR], covariance[_SHEAR, _SHEAR] + prior
    gain = np.linalg.solve(spread, covariance[_SHEAR]).T
    evidence = -0.5 * float(shear @ np.linalg.solve(spread, shear) + np.log(np.linalg.det(spread)))
    return contact - gain @ shear, covariance - gain @ covariance[_SHEAR], evidence


def _log_density(found: Fit, noise_std: Floats) -> float:
    """Evidence of a fit, with the constant that it leaves out."""
    return found.log_evidence - float(np.log(noise_std).sum()) - 0.5 * found.count * float(np.log(2.0 * np.pi))


def hertz_traction(distance_m: Floats, radius_m: Floats | float) -> Floats:
    """3 / (2 pi a^2) sqrt(1 - r^2 / a^2), in Pa per newton; 0 outside of the disc."""
    height = np.sqrt(np.maximum(1.0 - (distance_m / radius_m) ** 2, 0.0))
    return np.asarray(1.5 / (np.pi * np.square(radius_m)) * height, np.float64)


def hertz_displacement(half_space: HalfSpace, offset_m: Floats, radius_m: float) -> Floats:
    """Displacement of the surface at offsets (n, 2) from the centre of a disc of radius a, in metres per newton.

    Johnson, Contact Mechanics, 1985: equations (3.41) to (3.43) for a force along z, (3.91) and (3.92) for one along x;
    what the latter does along z follows by reciprocity.

    Returns
    -------
    Shape (force x, y, z; displacement x, y, z; n).
    """
    nu, a = half_space.poisson_ratio, radius_m
    x, y = offset_m.T
    r = np.hypot(x, y)
    sine = a / np.maximum(r, a)  # 1 within the disc
    angle, cosine = np.arcsin(sine), np.sqrt(1.0 - sine**2)
    even = (2.0 * a**2 - r**2) * angle + a * r * cosine
    turning = r**2 * angle + (2.0 * a**2 - r**2) * sine * cosine
    squared = np.where(r > 0.0, r, 1.0) ** 2
    inward = (1.0 - 2.0 * nu) / 6.0 * a**2 * (1.0 - np.maximum(1.0 - (r / a) ** 2, 0.0) ** 1.5) / squared
    along = turning * nu / 16.0 * (x**2 - y**2) / squared
    found = np.empty((3, 3, r.size))
    found[0, 0], found[1, 1] = (2.0 - nu) / 8.0 * even + along, (2.0 - nu) / 8.0 * even - along
    found[0, 1] = found[1, 0] = turning * nu / 8.0 * x * y / squared
    found[2, 2] = (1.0 - nu) / 4.0 * even
    found[0, 2], found[1, 2] = inward * a * x, inward * a * y
    found[2, 0], found[2, 1] = -found[0, 2], -found[1, 2]
    return found * (1.5 / (np.pi * a**3 * half_space.shear_modulus_pascal))
