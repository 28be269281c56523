"""From the signals of a skin to what happens on its surface: map, contacts and events, by the decoder that fits it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from resonator_daemon.arrays import Bools, Floats
from resonator_daemon.decoding.decoded import Decoded
from resonator_daemon.decoding.layout import as_grid
from resonator_daemon.decoding.skin import DecodingOptions, Skin
from resonator_daemon.decoding.skin_contacts import SkinContact, SkinContacts, SkinEvent
from resonator_daemon.decoding.surface_estimators import surface_estimator
from resonator_daemon.reasons import Reason, ReasonCode

_NOISE_CHANGE = 1.5  # of a channel: a smaller one hardly changes what is decoded
_NOISY = 3.0  # times a signal's usual noise: it counts as lost
_NOISE_STEP = 1.0 / 32.0  # of an octave: what noise is rounded to, so that a set-up can be found again


@dataclass(frozen=True)
class SurfaceReading:
    """One frame, read."""

    decoder: str
    decoded: Decoded
    contacts: tuple[SkinContact, ...] = ()
    events: tuple[SkinEvent, ...] = ()


class SkinDecoder:
    """Sequential decoder of the frames of one skin.

    Parameters
    ----------
    skin
    options
        Contact physics needs the open-plane decoder. ValueError for what cannot be decoded so.
    noise_std
        Standard deviation of the noise of the dimensionless signals, (3, n), as `rounded_noise` makes it.
    progress
        Called with each step of the set-up.

    Attributes
    ----------
    name
        What decodes: the method, "+contact" with contact physics, or "template".
    shape
        Of the places of the map, (ny, nx) or (n,).
    contacts
        That are followed.
    """

    def __init__(
        self, skin: Skin, options: DecodingOptions, noise_std: Floats, progress: Callable[[str], None]
    ) -> None:
        self._noise_std = noise_std
        self._estimator = surface_estimator(skin, options, noise_std, progress)
        progress("contact shapes")
        self.contacts = SkinContacts(skin, noise_std, options.friction_coefficient)
        self._frame = np.full(noise_std.shape, np.nan)
        self.name = self._estimator.name
        self.shape = self._estimator.shape

    def fits(self, noise_std: Floats) -> bool:
        """Return whether the decoder still serves signals of such noise, (3, n); silent channels are ignored."""
        ratios, known = noise_std / self._noise_std, _known(noise_std)
        # A median is below a bound where at least half of the values are: no median has to be computed.
        half = 0.5 * np.count_nonzero(known, axis=1)
        below = np.count_nonzero(known & (ratios < _NOISE_CHANGE), axis=1)
        above = np.count_nonzero(known & (ratios > 1.0 / _NOISE_CHANGE), axis=1)
        return bool(((below >= half) & (above >= half)).all())

    def reset(self, reason: Reason) -> tuple[SkinEvent, ...]:
        """Discard the frames before; return the releases of their contacts, for this reason."""
        if self._estimator.physics is not None:
            self._estimator.physics.reset()
        return self.contacts.reset(reason)

    def number_from(self, last_contact_id: int) -> None:
        """Continue the numbers of contacts after those of an earlier decoder."""
        self.contacts.tracker.last_id = last_contact_id

    def succeed(self, other: "SkinDecoder") -> tuple[SkinEvent, ...]:
        """Replace another decoder: return the releases of its contacts, and continue its numbers."""
        self.number_from(other.contacts.tracker.last_id)
        return other.reset(Reason(ReasonCode.DECODER_RESET, "the decoder was set up again, for another noise"))

    def decode(self, signals: Floats, noise_std: Floats) -> SurfaceReading:
        """Read a frame, both arrays (3, n): its map and its contacts."""
        return self.read_contacts(self.decode_map(signals, noise_std))

    def decode_map(self, signals: Floats, noise_std: Floats) -> Decoded:
        """Read the map of a frame, both arrays (3, n); `read_contacts`, which takes as long again, is to follow.

        What is far noisier than usual, or of unknown noise, counts as lost.
        """
        self._frame = self._sound(signals, noise_std)
        return self._estimator.read(self._frame)

    def read_contacts(self, decoded: Decoded) -> SurfaceReading:
        """Read the contacts of the frame whose map was decoded last."""
        patches = self._estimator.patches(decoded)
        reading = SurfaceReading(self.name, decoded, *self.contacts.update(self._frame, patches))
        if self._estimator.physics is not None:
            self._estimator.physics.friction_estimate = self.contacts.friction_estimate
        return reading

    def decode_alone(self, signals: Floats, noise_std: Floats) -> SurfaceReading:
        """Read a frame, both arrays (3, n), as if it were the first: contacts have no past, and there are no events.

        With `DecodingOptions.background`, contact physics would have no matrices for it.
        """
        frame = self._sound(signals, noise_std)
        if self._estimator.physics is not None:
            self._estimator.physics.reset(rows_kept=True)
        decoded = self._estimator.read(frame)
        return SurfaceReading(self.name, decoded, self.contacts.alone(frame, self._estimator.patches(decoded)))

    def _sound(self, signals: Floats, noise_std: Floats) -> Floats:
        return np.where(noise_std < _NOISY * self._noise_std, signals, np.nan)

    def rebuild(self) -> bool:
        """Update matrices if a contact has moved, and return whether; it may run in another thread than `decode`."""
        return self._estimator.physics is not None and self._estimator.physics.rebuild()


def rounded_noise(skin: Skin, noise_std: Floats) -> Floats | None:
    """Noise to build a decoder for, out of that of a frame, (3, n); None while a channel has no signal.

    On a grid it is the channel's median, because equal noise lets the grid's symmetry work; elsewhere each signal's
    own, the median where that is not known.
    """
    known = _known(noise_std)
    if not known.any(axis=1).all():
        return None
    median = np.array([[np.median(row[keep])] for row, keep in zip(noise_std, known, strict=True)])
    on_grid = as_grid(skin.site_positions_m) is not None
    chosen = np.broadcast_to(median, noise_std.shape) if on_grid else np.where(known, noise_std, median)
    return np.asarray(np.exp2(np.round(np.log2(chosen) / _NOISE_STEP) * _NOISE_STEP), np.float64)


def _known(noise_std: Floats) -> Bools:
    return np.isfinite(noise_std) & (noise_std > 0.0)
