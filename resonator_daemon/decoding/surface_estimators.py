"""Estimators of what happens on a skin: a map with its patches, or a single contact if a map would mislead."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding.contact_physics.decoder import ContactDecoder
from resonator_daemon.decoding.decoded import Decoded
from resonator_daemon.decoding.fitting.parametric_decoder import ParametricDecoder, sparse_reason
from resonator_daemon.decoding.fourier.decoder import FourierDecoder
from resonator_daemon.decoding.layout import as_grid, cell_areas_m2
from resonator_daemon.decoding.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.decoding.patches import Patch, PatchFinder
from resonator_daemon.decoding.skin import DecodingOptions, Skin

# Of sums, relative, inside and at the border of the sites; both to fit closed-form contacts.
_CUT_BIAS = 0.07, 0.15  # over a map cut to its support
_SUM_BIAS = 0.0, 0.03  # of the traction without bounds: beyond the border nothing determines the load well


class MapEstimator:
    """Linear map, with contact physics if asked for; its net loads have no bias.

    Attributes
    ----------
    name
        Of the decoder.
    shape
        Of the places of its maps, (ny, nx) or (n,).
    physics
        None without contact physics.
    """

    def __init__(
        self, skin: Skin, options: DecodingOptions, noise_std: Floats, progress: Callable[[str], None]
    ) -> None:
        sites_m = skin.site_positions_m
        grid = as_grid(sites_m)
        self.name: str = options.method
        self.shape: tuple[int, ...] = grid.shape if grid else (len(sites_m),)
        self.physics: ContactDecoder | None = None
        self._linear: OpenPlaneDecoder | FourierDecoder
        progress(f"{options.method} decoder of {len(sites_m)} sites")
        if options.method == "fourier":
            if grid is None or not np.isclose(grid.pitch_x_m, grid.pitch_y_m):
                raise ValueError(f'method "fourier" needs a square grid, {len(sites_m)} sites form none')
            self._linear = FourierDecoder(
                skin.half_space,
                grid.shape,
                grid.pitch_x_m,
                skin.depth_m,
                noise_std.reshape(3, *grid.shape),
                prior=skin.prior,
            )
        else:
            self._linear = OpenPlaneDecoder(
                skin.half_space,
                sites_m,
                skin.depth_m,
                noise_std,
                gain_std=skin.gain_std,
                prior=skin.prior,
            )
            if options.contact_physics:
                progress("contact physics")
                self.physics = ContactDecoder(self._linear, options.friction_coefficient, background=options.background)
                self.name += "+contact"
        self._displacement = options.displacement
        self._finder = PatchFinder(sites_m, cell_areas_m2(sites_m), skin.depth_m)

    def read(self, frame: Floats) -> Decoded:
        """Return the map of a frame (3, n); frames are in the order of time."""
        decoder = self.physics or self._linear
        return decoder.decode(frame.reshape(3, *self.shape), displacement=self._displacement)

    def patches(self, decoded: Decoded) -> list[Patch]:
        """Return the patches on the map that was read last."""
        if self.physics is None:
            return self._finder.find(decoded.traction_pascal, decoded.traction_std_pascal)
        return net_patches(self._finder, self.physics, decoded)


def net_patches(finder: PatchFinder, physics: ContactDecoder, decoded: Decoded) -> list[Patch]:
    """Return the patches on the map that contact physics decoded last, with its net loads.

    While it has none, because its matrices are being prepared, the map cut to its support is summed: biased by some
    percent.
    """
    traction, std = decoded.traction_pascal.reshape(3, -1), decoded.traction_std_pascal.reshape(3, -1)
    regions = finder.regions(traction[2], std[2])
    net_loads = physics.net_loads(regions, (0.0, 0.0))
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


class ParametricEstimator:
    """Parametric fit of the one contact that explains a frame best; methods and attributes as of `MapEstimator`."""

    name = "template"
    physics: ContactDecoder | None = None

    def __init__(
        self, skin: Skin, options: DecodingOptions, noise_std: Floats, progress: Callable[[str], None]
    ) -> None:
        self._displacement = options.displacement
        self._patch: Patch | None = None
        self.shape: tuple[int, ...] = (len(skin.site_positions_m),)
        progress(f"parametric contact fit of {self.shape[0]} sites")
        self._decoder = ParametricDecoder(
            skin.half_space, skin.site_positions_m, skin.depth_m, noise_std, gain_std=skin.gain_std
        )

    def read(self, frame: Floats) -> Decoded:
        decoded, self._patch = self._decoder.decode_with_patch(frame, displacement=self._displacement)
        return decoded

    def patches(self, _decoded: Decoded) -> list[Patch]:
        return [] if self._patch is None else [self._patch]


def surface_estimator(
    skin: Skin, options: DecodingOptions, noise_std: Floats, progress: Callable[[str], None]
) -> MapEstimator | ParametricEstimator:
    """Return the estimator for the layout of the sites; ValueError for a skin or a method that cannot be decoded."""
    if options.method == "open-plane" and sparse_reason(skin.site_positions_m, skin.depth_m):
        return ParametricEstimator(skin, options, noise_std, progress)
    return MapEstimator(skin, options, noise_std, progress)
