"""Decoder of a regular array by the multivariate Wiener inverse, frequency by frequency.

Four things that a small array needs are added to eq. (5) of Karason, Srinivasan and Annaswamy:

- The array is extended to 1.5 times its side, edge samples repeated and tapered to 0, because the fields fall off so
  slowly that the period of the plain transform would fold 10 % of them back.
- The prior of the traction is smooth: its power spectrum is q (r, r, 1) / (1 + omega^2 l^2)^2 for x, y, z.
- Its scale q is chosen for each frame out of a grid by maximum likelihood. (Generalised cross-validation fails badly
  where a contact crosses the border.)
- The noise is at least the declared one. Where the best fit leaves more (gain errors, a contact across the border), the
  excess counts as noise and widens the error bars; without that, small noise would make errors of the model explode.

Eq. (5) as printed holds only for noise of one power in all channels; here it holds for any.
"""

import numpy as np
from numpy.typing import ArrayLike

from resonator_daemon.base.arrays import Bools, Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.elastic.grid import SpectralGrid
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.surface.decoded import (
    CHI2_LIMIT,
    KNOWN_LIMIT,
    SIGNAL_LIMIT,
    UNEXPLAINED_LIMIT,
    Decoded,
    noise_of_signals,
    stated,
)
from resonator_daemon.estimate.surface.fourier.wiener import ExtendedTransform, SpectralWiener, product
from resonator_daemon.estimate.surface.skin import DEFAULT_PRIOR, Prior

# Standard deviation of the prior over the traction that makes a signal of the noise.
_SCALES = np.logspace(-1.0, 5.0, 30)
_PRIOR_LIMIT_PASCAL = 1e30  # keeps squares of it well within double precision
_BORDER_SHARE = 0.04  # of the energy of f_z on the outermost sites ...
_BORDER_SIGMAS = 1.5  # ... and their rms over the standard deviation

_FILL_ROUNDS = 20  # most rounds of the model's own prediction ...
_FILL_TOLERANCE = 0.3  # ... which end when it changes by less than this share of the noise


def _kernel(count: int, width: float) -> Floats:
    """Return weights (count, count) that fall with the distance of two samples, a few times faster beyond `width`."""
    distance = np.subtract.outer(np.arange(count), np.arange(count))
    return np.asarray(1.0 / (1.0 + (distance / width) ** 2) ** 2, np.float64)


class FourierDecoder:
    """Linear minimum-mean-square estimate of tractions and displacements on a grid of sites.

    The Wiener inverse of Karason, Srinivasan and Annaswamy, "Encoding and Decoding of Static Information in Tactile
    Sensing Systems", eq. (5), extended as the head of this file has it.

    Parameters
    ----------
    half_space
    shape
        (ny, nx) of the array.
    pitch_m
        Spacing of the sites along both axes.
    depth_m
        Depth of the sites, at least 0.
    noise_std
        Standard deviation of the noise of the dimensionless signals: a scalar, (3,), or what broadcasts to (3, ny, nx).
        The solution uses the mean variance of each channel, because it works frequency by frequency.
    prior
        Prior of the traction.

    Raises
    ------
    ValueError
        A shape that does not fit, or a parameter that is not finite and above 0 (depth: at least 0).
    """

    def __init__(
        self,
        half_space: HalfSpace,
        shape: tuple[int, int],
        pitch_m: float,
        depth_m: float,
        noise_std: ArrayLike,
        *,
        prior: Prior = DEFAULT_PRIOR,
    ) -> None:
        SpectralGrid(shape, pitch_m)  # refuses what is no grid
        std_pascal = prior.std_pascal
        if std_pascal is not None and std_pascal > _PRIOR_LIMIT_PASCAL:
            limit = f"must be at most {_PRIOR_LIMIT_PASCAL:.0e}, where it no longer regularises"
            raise ValueError(f"std_pascal is {std_pascal}, {limit}")
        channel_std = np.sqrt(np.mean(noise_of_signals(noise_std, shape) ** 2, axis=(1, 2)))

        self._shape = shape
        self._transform = ExtendedTransform(shape)
        grid = SpectralGrid(self._transform.extended_shape, pitch_m)
        bin_power = self._transform.noise_power
        forward = grid.transfer_matrix(half_space, "sensor", "traction", depth_m)
        bin_std = np.sqrt(bin_power)[..., None] * channel_std
        noise_traction = 2.0 * half_space.shear_modulus_pascal * np.sqrt(np.mean(channel_std**2))
        scales = (noise_traction * _SCALES) ** 2 if std_pascal is None else np.array([std_pascal**2])

        spectrum = prior.spectrum_m2(grid.omega_x**2 + grid.omega_y**2)
        spectrum *= grid.shape[0] * grid.shape[1] / (grid.multiplicity * spectrum).sum()  # unit variance of f_z
        prior_root = np.sqrt(spectrum[..., None] * prior.powers)
        self._wiener = SpectralWiener(forward, prior_root, bin_std, grid.multiplicity, scales)
        self._noise_variance = float(np.mean(channel_std**2))
        self._neighbours_y, self._neighbours_x = (_kernel(n, 0.5) for n in shape)
        self._blur_y, self._blur_x = (_kernel(n, 0.5 * max(depth_m / pitch_m, 1.0)) for n in shape)
        compliance = grid.transfer_matrix(half_space, "displacement", "traction", 0.0)
        self._compliance = np.ascontiguousarray(np.moveaxis(compliance.reshape(-1, 3, 3), 0, -1))
        self._border = np.ones(shape, np.bool_)
        self._border[1:-1, 1:-1] = False
        self._evidence_offset = 1.5 * (grid.multiplicity * np.log(bin_power)).sum()  # repeated samples are no new ones

    def decode(self, signals: ArrayLike, *, displacement: bool = False) -> Decoded:
        """Return tractions, and displacements if asked for, of frames of signals [3 p_n / (2 E), eps_xz, eps_yz].

        Parameters
        ----------
        signals
            Shape (..., 3, ny, nx), dimensionless. A signal that is NaN, infinite or beyond 10 counts as lost: the
            model's prediction from the others takes its place and the error bar around it widens; that takes up to
            twenty times as long.
        displacement
            Also the surface displacement that the decoded traction causes, alone on the plane; for a Poisson's ratio
            below 1/2 without the part that is linear in x and y.

        Returns
        -------
        Decoded
            `traction_std_pascal`: from the posterior covariance of the estimate at the frame's scale, the same
            everywhere but for lost signals; right on average over the array, too small under a contact.
            `chi2`: mean square of the innovation in units of prior and declared noise. `log_evidence`: Whittle's
            likelihood, for the number of samples measured. `border_contact`: the outermost sites hold more than 4 % of
            the energy of f_z, their rms exceeds 1.5 standard deviations. `status`: "ok", where `reason` counts lost
            signals; "no_signal", less than half of a channel known; "rejected", the residual exceeds ten times the
            noise and half of the energy, so that no load explains the frame.

        Raises
        ------
        ValueError
            Signals of another shape, or not numbers.
        """
        given = np.asarray(signals, np.float64)
        wanted = (3, *self._shape)
        if given.shape[-3:] != wanted:
            raise ValueError(f"signals have shape {given.shape}, must be (..., {', '.join(map(str, wanted))})")
        decoded = [self._decode(frame, displacement) for frame in given.reshape(-1, *wanted)]
        leading = given.shape[:-3]
        return Decoded.stack(decoded, leading, wanted) if leading else decoded[0]

    def _decode(self, frame: Floats, displacement: bool) -> Decoded:
        known = np.abs(frame) <= SIGNAL_LIMIT  # False for NaN
        if known.all():
            return self._decode_whole(frame, 1.0, np.ones((1, 1)), displacement, None)
        worst = float(known.mean(axis=(1, 2)).min())
        if worst < KNOWN_LIMIT:
            text = f"{worst:.0%} of a channel known (finite, within {SIGNAL_LIMIT}), needs {KNOWN_LIMIT:.0%}"
            missing = Reason(ReasonCode.SIGNALS_MISSING, text)
            return Decoded.unknown(frame.shape, displacement, np.nan, np.nan, "no_signal", missing)
        filled, settled = self._impute(frame, known)
        reason = f"{known.size - known.sum()} of {known.size} signals lost and filled in"
        reason += "" if settled else "; too many side by side for that to settle"
        lost = Reason(ReasonCode.SIGNALS_LOST, reason)
        return self._decode_whole(filled, float(known.mean()), self._density(known), displacement, lost)

    def _impute(self, frame: Floats, known: Bools) -> tuple[Floats, bool]:
        """Replace lost signals by the model's prediction from the others; False where that has not settled.

        A mean of the neighbours, then expectation and maximisation in turn, with Nesterov's momentum.
        """
        total = self._neighbours_y @ np.where(known, frame, 0.0) @ self._neighbours_x
        filled = predicted = np.where(known, frame, total / (self._neighbours_y @ known @ self._neighbours_x))
        limit = _FILL_TOLERANCE**2 * self._noise_variance * (known.size - known.sum())
        for n in range(_FILL_ROUNDS):
            fit = self._wiener.fit(self._transform.to_spectrum(filled), float(known.mean()))
            change = np.where(known, 0.0, self._transform.to_space(self._wiener.signals(fit)) - predicted)
            predicted = predicted + change
            filled = predicted + n / (n + 3.0) * change
            if np.sum(change**2) < limit:
                return predicted, True
        return predicted, False

    def _density(self, known: Bools) -> Floats:
        """Share of known signals around each site, of the channel that has lost most there."""
        ones = np.ones(self._shape)
        shares = (self._blur_y @ known @ self._blur_x) / (self._blur_y @ ones @ self._blur_x)
        return np.asarray(shares.min(axis=0), np.float64)

    def _decode_whole(
        self, frame: Floats, known_share: float, density: Floats, displacement: bool, reason: Reason | None
    ) -> Decoded:
        """Decode a frame without gaps; `density` (1, 1) or (ny, nx) as the inverse takes it."""
        fit = self._wiener.fit(self._transform.to_spectrum(frame), known_share)
        chi2 = fit.chi2
        log_evidence = self._transform.samples_share * (fit.log_evidence + known_share * self._evidence_offset)
        left = chi2 * self._noise_variance / max(float(np.mean(frame**2)), np.finfo(np.float64).tiny)
        if chi2 > CHI2_LIMIT and left > UNEXPLAINED_LIMIT:
            text = f"chi2 {chi2:.3g} exceeds {CHI2_LIMIT:.0f} and {left:.0%} of the energy remain unexplained"
            why = Reason(ReasonCode.SIGNALS_UNEXPLAINED, text)
            return Decoded.unknown(frame.shape, displacement, log_evidence, chi2, "rejected", why)

        tractions = self._wiener.tractions(fit)
        traction = np.ascontiguousarray(self._transform.to_space(tractions))
        std = np.sqrt(self._wiener.traction_variance(fit, density))
        moved = None
        if displacement:
            moved = np.ascontiguousarray(self._transform.to_space(product(self._compliance, tractions)))
        normal = traction[2] ** 2
        significant = self._border.sum() * (_BORDER_SIGMAS * std[2].mean()) ** 2
        at_border = normal[self._border].sum() > max(_BORDER_SHARE * normal.sum(), significant)
        std = np.broadcast_to(std, traction.shape).copy()
        return Decoded(traction, std, moved, bool(at_border), log_evidence, chi2, "ok", *stated(reason))
