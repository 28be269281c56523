"""From the signals of a skin to what happens on its surface: map, contacts and events, by the decoder that fits it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from resonator_daemon.base.arrays import Bools, Floats
from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.surface.contact_physics.decoder import ContactDecoder
from resonator_daemon.estimate.surface.decoded import Decoded
from resonator_daemon.estimate.surface.fourier.decoder import FourierDecoder
from resonator_daemon.estimate.surface.layout import as_grid, cell_areas_m2
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.estimate.surface.patches import Patch, PatchFinder
from resonator_daemon.estimate.surface.site_check import SiteCheck
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin, refuse_undecodable
from resonator_daemon.estimate.surface.skin_contacts import SkinContact, SkinContacts, SkinEvent

_NOISE_CHANGE = 1.5  # of a channel: a smaller one hardly changes what is decoded
_NOISY = 3.0  # times a signal's usual noise: it counts as lost
_NOISE_STEP = 1.0 / 32.0  # of an octave: what noise is rounded to, so that a set-up can be found again

# Of sums, relative, inside and at the border of the sites; both to fit closed-form contacts.
_CUT_BIAS = 0.07, 0.15  # over a map cut to its support
_SUM_BIAS = 0.0, 0.03  # of the traction without bounds: beyond the border nothing determines the load well


def net_patches(finder: PatchFinder, physics: ContactDecoder, decoded: Decoded) -> list[Patch]:
    """Return the patches on the map that contact physics decoded last, with its net loads.

    While it has none, because its matrices are being prepared, the map cut to its support is summed: biased by some
    percent.
    """
    traction, std = decoded.traction_pascal.reshape(3, -1), decoded.traction_std_pascal.reshape(3, -1)
    regions = finder.regions(traction[2], std[2])
    net_loads = physics.net_loads(regions)
    sums = finder.sums(regions, traction, std) if None in net_loads else net_loads
    patches = []
    for region, net_load, load in zip(regions, net_loads, sums, strict=True):
        if load is not None:
            biases = _CUT_BIAS if net_load is None else _SUM_BIAS
            patches.append(_widened(finder.patch(region, net_load or load), biases))
    return sorted(patches, key=lambda patch: -float(patch.force_newton[2]))


def _widened(patch: Patch, biases: tuple[float, float]) -> Patch:
    """Widen standard deviations by what sums may be off by, inside and at the border of the sites."""
    bias = biases[patch.at_border]
    if bias == 0.0:
        return patch
    off_newton = bias * float(np.linalg.norm(patch.force_newton))
    lever_m = float(np.linalg.norm(patch.centroid_m)) + patch.radius_m
    return replace(
        patch,
        centroid_std_m=np.hypot(patch.centroid_std_m, bias * patch.radius_m),
        force_std_newton=np.hypot(patch.force_std_newton, off_newton),
        moment_std_newton_m=np.hypot(patch.moment_std_newton_m, off_newton * lever_m),
    )


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
        What decodes: the method, "+contact" with contact physics.
    shape
        Of the places of the map, (ny, nx) or (n,).
    contacts
        That are followed.
    site_check
        Detector of faulty sites; None for the method `fourier`.
    """

    def __init__(
        self, skin: Skin, options: DecodingOptions, noise_std: Floats, progress: Callable[[str], None]
    ) -> None:
        refuse_undecodable(skin, options)
        sites_m, grid = skin.site_positions_m, as_grid(skin.site_positions_m)
        self._noise_std = noise_std
        self._noisy = _NOISY * noise_std
        self.name: str = options.method
        self.shape: tuple[int, ...] = grid.shape if grid else (len(sites_m),)
        self._physics: ContactDecoder | None = None
        self.site_check: SiteCheck | None = None
        self._linear: OpenPlaneDecoder | FourierDecoder
        progress(f"{options.method} decoder of {len(sites_m)} sites")
        body, depth_m, prior = skin.half_space, skin.depth_m, skin.prior
        if grid and options.method == "fourier":
            noise = noise_std.reshape(3, *grid.shape)
            self._linear = FourierDecoder(body, grid.shape, grid.pitch_x_m, depth_m, noise, prior=prior)
        else:
            self._linear = OpenPlaneDecoder(body, sites_m, depth_m, noise_std, gain_std=skin.gain_std, prior=prior)
            self.site_check = SiteCheck(self._linear)
            if options.contact_physics:
                progress("contact physics")
                coefficient = options.friction_coefficient
                self._physics = ContactDecoder(self._linear, coefficient, background=options.background)
                self.name += "+contact"
        self._displacement = options.displacement
        self._finder = PatchFinder(sites_m, cell_areas_m2(sites_m), depth_m)
        progress("contact shapes")
        self.contacts = SkinContacts(skin, noise_std, options.friction_coefficient)
        self._frame = self._frame_of_all_sites = np.full(noise_std.shape, np.nan)

    def fits(self, noise_std: Floats) -> bool:
        """Return whether the decoder still serves signals of such noise, (3, n); silent channels are ignored."""
        ratios = noise_std / self._noise_std
        alike = np.count_nonzero((ratios < _NOISE_CHANGE) & (ratios > 1.0 / _NOISE_CHANGE), axis=1)
        return bool((2 * alike >= np.count_nonzero(_known(noise_std), axis=1)).all())

    def reset(self, reason: Reason) -> tuple[SkinEvent, ...]:
        """Discard the frames before; return the releases of their contacts, for this reason."""
        if self._physics is not None:
            self._physics.reset()
        return self.contacts.reset(reason)

    def start_cold(self) -> None:
        """Discard the frames before, what was estimated from them, and failed checks, unless a contact is followed."""
        if self.contacts.tracker.ids:
            return
        if self._physics is not None:
            self._physics.reset()
            self._physics.friction_estimate = None
        if self.site_check is not None:
            self.site_check.failed_checks.clear()
        self.contacts.start_cold()

    def number_from(self, last_contact_id: int) -> None:
        """Continue the numbers of contacts after those of an earlier decoder."""
        self.contacts.tracker.last_id = last_contact_id

    def succeed(self, other: "SkinDecoder") -> tuple[SkinEvent, ...]:
        """Replace another decoder: return the releases of its contacts, and continue its numbers."""
        self.number_from(other.contacts.tracker.last_id)
        if self.site_check is not None and other.site_check is not None:
            self.site_check.failed_checks = other.site_check.failed_checks
        return other.reset(Reason(ReasonCode.DECODER_RESET, "the decoder was set up again, for another noise"))

    def decode(self, signals: Floats, noise_std: Floats) -> SurfaceReading:
        """Read a frame, both arrays (3, n): its map and its contacts."""
        return self.read_contacts(self.decode_map(signals, noise_std))

    def decode_map(self, signals: Floats, noise_std: Floats) -> Decoded:
        """Read the map of a frame, both arrays (3, n); `read_contacts`, which takes as long again, is to follow.

        What is far noisier than usual, or of unknown noise, counts as lost; so do the sites that `site_check` excludes.
        """
        sound = noise_std < self._noisy
        if self.contacts.offset.any():
            signals = signals - self.contacts.offset[:, None] * self._noise_std
        self._frame = self._frame_of_all_sites = signals if sound.all() else np.where(sound, signals, np.nan)
        if self.site_check is not None and (excluded := self.site_check.excluded):
            self._frame = self._frame_of_all_sites.copy()
            self._frame[:, excluded] = np.nan
        decoder = self._physics or self._linear
        return decoder.decode(self._frame.reshape(3, *self.shape), displacement=self._displacement)

    def read_contacts(self, decoded: Decoded) -> SurfaceReading:
        """Read the contacts of the frame whose map was decoded last."""
        if self._physics is None:
            patches = self._finder.find(decoded.traction_pascal, decoded.traction_std_pascal)
        else:
            patches = net_patches(self._finder, self._physics, decoded)
        reading = SurfaceReading(self.name, decoded, *self.contacts.update(self._frame, patches))
        if self._physics is not None:
            self._physics.friction_estimate = self.contacts.friction_estimate
        return reading

    def check(self, pause: Callable[[], None] = lambda: None) -> None:
        """Check the frame that was decoded last, in which something presses: its sites, and the shape of the contact.

        `pause` as of `rebuild`.
        """
        if self.site_check is not None:
            self.site_check.check(self._frame_of_all_sites, pause)
        self.contacts.fit_shapes(pause)

    @property
    def suspects(self) -> tuple[int, ...]:
        """Indices of the suspect sites."""
        return () if self.site_check is None else self.site_check.suspects

    def rebuild(self, pause: Callable[[], None] = lambda: None) -> bool:
        """Update matrices if a contact has moved, and return whether; `pause` as of `ContactDecoder.rebuild`."""
        return self._physics is not None and self._physics.rebuild(pause)


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
