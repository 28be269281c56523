"""Tones of the corners against the codes of the sites, at a low rate: how a site was identified."""

import math
from collections.abc import Sequence

from resonator_daemon.base.reasons import ReasonCode
from resonator_daemon.estimate.forces.force_sites import ForceSites
from resonator_daemon.estimate.forces.readings import CapturedTone, CornerTone
from resonator_daemon.estimate.forces.site_identification import SiteForce
from resonator_daemon.estimate.tones.tone_count import ToneCount


class CornerTones:
    """Makes the tones of the corners once in each period.

    Parameters
    ----------
    sites
    period_frames
        Periods are cut at multiples of it; None: tones are never due.
    """

    def __init__(self, sites: ForceSites, period_frames: int | None) -> None:
        self._f0_hz: list[list[float]] = sites.f0_hz.tolist()
        self._sensitivity: list[list[float]] = sites.sensitivity.tolist()
        self._model_error = sites.model_error
        self._period_frames = period_frames
        self._period: int | None = None  # of the last tones

    def due(self, sequence: int) -> bool:
        """Return whether the frame with this number is the first that is asked about in its period."""
        if self._period_frames is None or (period := sequence // self._period_frames) == self._period:
            return False
        self._period = period
        return True

    def tones(
        self,
        counts: Sequence[ToneCount],
        pilot: Sequence[float],
        held: Sequence[bool],
        forces: Sequence[SiteForce],
        common_mode: tuple[Sequence[float], float],
        oscillator_std: float,
    ) -> tuple[CornerTone, ...]:
        """Return the tones of the corners in their order.

        Parameters
        ----------
        counts
            (channels,), of each channel that has counted a tone over the whole window.
        pilot
            (channels,), relative frequency error by the pilot; NaN on channels that do not have it.
        held
            (channels,), whether a channel counts a tone now.
        forces
            As identified, before the response of the sites is taken out.
        common_mode
            Relative frequency error (channels,), and its standard deviation.
        oscillator_std
            Relative noise that all channels share.
        """
        of_channel = {channel: force for force in forces for channel in force.channels}
        g, common_mode_std = common_mode
        made = []
        for channel, count in enumerate(counts):
            if math.isnan(count.frequency_hz):
                code = ReasonCode.WINDOW_NOT_FULL if held[channel] else ReasonCode.CHANNELS_SILENT
                made.append(CornerTone("none", None, math.nan, math.nan, math.nan, code))
                continue
            frequency_hz = count.frequency_hz / (1.0 + g[channel])
            noise_hz = frequency_hz * math.hypot(count.std, oscillator_std)
            pending = ReasonCode.COMMON_MODE_PENDING if math.isnan(frequency_hz) else None
            force = of_channel.get(channel)
            captured: CapturedTone = (
                "site" if force is not None else "unidentified" if math.isnan(pilot[channel]) else "pilot"
            )
            residual = math.nan
            if force is not None:
                std = math.hypot(count.std, oscillator_std, common_mode_std)
                by_force = self._sensitivity[force.site][channel] * force.force_newton
                shift = 1.0 - self._f0_hz[force.site][channel] / frequency_hz
                residual = (shift - by_force) / math.hypot(std, self._model_error * by_force)
            site = None if force is None else force.site
            made.append(CornerTone(captured, site, frequency_hz, noise_hz, residual, pending))
        return tuple(made)
