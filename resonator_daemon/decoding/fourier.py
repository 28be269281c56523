"""Decoder of a regular array by the multivariate Wiener inverse, frequency by frequency.

Four things that a small array needs are added to eq. (5) of Karason, Srinivasan and Annaswamy:

- The array is extended to 1.5 times its side, edge samples repeated and tapered to 0, because the fields fall off so
  slowly that the period of the plain transform would fold 10 % of them back.
- The prior of the traction is smooth: its power spectrum is q (r, r, 1) / (1 + omega^2 l^2)^2 for x, y, z.
- Its scale q is chosen for each frame out of a bank by maximum likelihood. (Generalised cross-validation fails badly
  where a contact crosses the border.)
- The noise is at least the declared one. Where the best fit leaves more (gain errors, a contact across the border), the
  excess counts as noise and widens the error bars; without that, small noise would make errors of the model explode.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from resonator_daemon.decoding.decoded import Decoded
from resonator_daemon.decoding.extension import extended_length, extension, noise_power
from resonator_daemon.decoding.parameters import check_prior, noise_of_signals
from resonator_daemon.decoding.wiener import SpectralWiener
from resonator_daemon.elastic import HalfSpace, SpectralGrid

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_BANK = np.logspace(-1.0, 5.0, 30)  # standard deviation of the prior over the traction that makes a signal of the noise
_REFILLS = 20  # most rounds of the model's own prediction over lost signals ...
_REFILL_TOLERANCE = 0.3  # ... which end when it changes by less than this share of the noise
_SIGNAL_LIMIT = 10.0  # a strain of ten: far beyond linear elasticity, only damage produces it
_KNOWN_LIMIT = 0.5  # smallest share of known signals in each channel
_CHI2_LIMIT = 100.0  # residual of ten times the declared noise ...
_UNEXPLAINED_LIMIT = 0.5  # ... and of half the frame's energy: no load on a half-space makes such signals
_BORDER_SHARE = 0.04  # of the energy of f_z on the outermost sites ...
_BORDER_SIGMAS = 1.5  # ... and their rms over the standard deviation


class FourierDecoder:
    """Linear minimum-mean-square estimate of tractions and displacements on a grid of sites.

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
    correlation_length_m
        l of the prior; between 0.5 and 2 mm results hardly change for sites 1 mm deep.
    tangential_ratio
        r of the prior: power of f_x and of f_y over that of f_z.
    prior_std_pascal
        Standard deviation of f_z under the prior, for a linear map in place of a scale chosen for each frame.

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
        correlation_length_m: float = 1e-3,
        tangential_ratio: float = 0.3,
        prior_std_pascal: float | None = None,
    ) -> None:
        SpectralGrid(shape, pitch_m)  # refuses what is no grid
        check_prior(correlation_length_m, tangential_ratio, prior_std_pascal)
        channel_std = np.sqrt(np.mean(noise_of_signals(noise_std, shape) ** 2, axis=(1, 2)))

        self._shape = shape
        self._side = extended_length(max(shape))  # square: the displacement of an isolated load is known for that
        grid = SpectralGrid((self._side, self._side), pitch_m)
        self._extend_y, self._extend_x = extension(shape[0], self._side), extension(shape[1], self._side)
        bin_power = noise_power(self._extend_y)[:, None] * noise_power(self._extend_x)[: self._side // 2 + 1]

        power = 1.0 / (1.0 + (grid.omega_x**2 + grid.omega_y**2) * correlation_length_m**2) ** 2
        power *= self._side**2 / (grid.multiplicity * power).sum()  # unit variance of f_z in space
        noise_traction = 2.0 * half_space.shear_modulus_pascal * np.sqrt(np.mean(channel_std**2))
        self._wiener = SpectralWiener(
            forward=grid.transfer_matrix(half_space, "sensor", "traction", depth_m),
            prior_std=np.sqrt(power[..., None] * [tangential_ratio, tangential_ratio, 1.0]),
            noise_std=np.sqrt(bin_power)[..., None] * channel_std,
            multiplicity=grid.multiplicity,
            bank=(noise_traction * _BANK) ** 2 if prior_std_pascal is None else np.array([prior_std_pascal**2]),
        )
        compliance = grid.transfer_matrix(half_space, "displacement", "traction", 0.0)
        self._compliance = np.ascontiguousarray(np.moveaxis(compliance.reshape(-1, 3, 3), 0, -1))
        self._border = np.ones(shape, np.bool_)
        self._border[1:-1, 1:-1] = False
        self._evidence_offset = 1.5 * (grid.multiplicity * np.log(bin_power)).sum()  # repeated samples are no new ones
        self._measured_share = shape[0] * shape[1] / self._side**2
        self._noise_variance = float(np.mean(channel_std**2))
        self._neighbours_y, self._neighbours_x = (_kernel(n, 0.5) for n in shape)
        self._blur_y, self._blur_x = (_kernel(n, 0.5 * max(depth_m / pitch_m, 1.0)) for n in shape)

    def decode(self, signals: ArrayLike, *, displacement: bool = False) -> Decoded:
        """Tractions, and displacements where asked for, of frames of signals [3 p_n / (2 E), eps_xz, eps_yz].

        Parameters
        ----------
        signals
            Shape (..., 3, ny, nx), dimensionless. A frame's result does not depend on the frames beside it. A signal
            that is NaN, infinite or beyond 10 counts as lost: the model's prediction from the others takes its place
            and the error bar around it widens.
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
        frames = np.asarray(signals, np.float64)
        wanted = (3, *self._shape)
        if frames.shape[-3:] != wanted:
            raise ValueError(f"signals have shape {frames.shape}, must be (..., {', '.join(map(str, wanted))})")
        leading = frames.shape[:-3]
        decoded = [self._decode_frame(frame, displacement) for frame in frames.reshape(-1, *wanted)]
        return Decoded.stack(decoded, leading, wanted) if leading else decoded[0]

    def _decode_frame(self, frame: Floats, displacement: bool) -> Decoded:
        known = np.abs(frame) <= _SIGNAL_LIMIT  # False for NaN
        worst, share = float(known.mean(axis=(1, 2)).min()), float(known.mean())
        if worst < _KNOWN_LIMIT:
            reason = f"{worst:.0%} of a channel known (finite, within {_SIGNAL_LIMIT}), needs {_KNOWN_LIMIT:.0%}"
            return self._unknown(displacement, np.nan, np.nan, "no_signal", reason)
        complete = bool(known.all())
        if complete:
            filled, reason = frame, ""
        else:
            filled, settled = self._fill(frame, known)
            reason = f"{known.size - known.sum()} of {known.size} signals lost and filled in"
            reason += "" if settled else "; too many side by side for that to settle"
        fit = self._wiener.fit(self._to_spectrum(filled), share)
        log_evidence = self._measured_share * (fit.log_evidence + share * self._evidence_offset)

        left = fit.chi2 * self._noise_variance / max(float(np.mean(filled**2)), np.finfo(np.float64).tiny)
        if fit.chi2 > _CHI2_LIMIT and left > _UNEXPLAINED_LIMIT:
            reason = f"chi2 {fit.chi2:.3g} exceeds {_CHI2_LIMIT:.0f} and {left:.0%} of the energy remain unexplained"
            return self._unknown(displacement, log_evidence, fit.chi2, "rejected", reason)

        spectrum = self._wiener.tractions(fit)
        traction = self._to_space(spectrum)
        density = np.ones((1, 1)) if complete else self._density(known)
        std = np.broadcast_to(np.sqrt(self._wiener.traction_variance(fit, density)), traction.shape).copy()
        border_energy = np.sum(traction[2][self._border] ** 2)
        significant = self._border.sum() * (_BORDER_SIGMAS * std[2].mean()) ** 2
        return Decoded(
            traction_pascal=traction,
            traction_std_pascal=std,
            displacement_m=self._to_space((self._compliance * spectrum).sum(axis=1)) if displacement else None,
            border_contact=bool(border_energy > max(_BORDER_SHARE * np.sum(traction[2] ** 2), significant)),
            log_evidence=log_evidence,
            chi2=fit.chi2,
            status="ok",
            reason=reason,
        )

    def _unknown(self, displacement: bool, log_evidence: float, chi2: float, status: str, reason: str) -> Decoded:
        traction, std, moved = np.full((3, 3, *self._shape), np.nan)
        return Decoded(traction, std, moved if displacement else None, False, log_evidence, chi2, status, reason)

    def _to_spectrum(self, signals: Floats) -> Complexes:
        extended = self._extend_y @ signals @ self._extend_x.T
        return np.asarray(fft.rfft2(extended, norm="ortho").reshape(3, -1), np.complex128)

    def _to_space(self, spectrum: Complexes) -> Floats:
        side, (ny, nx) = self._side, self._shape
        extended = fft.irfft2(spectrum.reshape(3, side, -1), s=(side, side), norm="ortho")
        return np.ascontiguousarray(extended[:, :ny, :nx])

    def _fill(self, frame: Floats, known: NDArray[np.bool_]) -> tuple[Floats, bool]:
        """Replace lost signals by the model's prediction from the others; False where that has not settled.

        A mean of the neighbours, then expectation and maximisation in turn, with Nesterov's momentum.
        """
        total = self._neighbours_y @ np.where(known, frame, 0.0) @ self._neighbours_x
        filled = predicted = np.where(known, frame, total / (self._neighbours_y @ known @ self._neighbours_x))
        limit = _REFILL_TOLERANCE**2 * self._noise_variance * (known.size - known.sum())
        for n in range(_REFILLS):
            fit = self._wiener.fit(self._to_spectrum(filled), float(known.mean()))
            change = np.where(known, 0.0, self._to_space(self._wiener.signals(fit)) - predicted)
            predicted = predicted + change
            filled = predicted + n / (n + 3.0) * change
            if np.sum(change**2) < limit:
                return predicted, True
        return predicted, False

    def _density(self, known: NDArray[np.bool_]) -> Floats:
        """Share of known signals around each site, of the channel that has lost most there."""
        ones = np.ones(self._shape)
        shares = (self._blur_y @ known @ self._blur_x) / (self._blur_y @ ones @ self._blur_x)
        return np.asarray(shares.min(axis=0), np.float64)


def _kernel(count: int, width: float) -> Floats:
    """Weights (count, count) that fall with the distance of two samples, a few times faster beyond `width`."""
    distance = np.subtract.outer(np.arange(count), np.arange(count))
    return np.asarray(1.0 / (1.0 + (distance / width) ** 2) ** 2, np.float64)
