"""The two ways to read a skin's surface: a map and the patches on it, or one contact where a map would mislead."""

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from resonator_daemon.decoding.contact_physics.decoder import ContactDecoder
from resonator_daemon.decoding.decoded import Decoded
from resonator_daemon.decoding.fitting.template import TemplateDecoder, is_sparse
from resonator_daemon.decoding.fourier.decoder import FourierDecoder
from resonator_daemon.decoding.layout import as_grid, cell_areas_m2
from resonator_daemon.decoding.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.decoding.patches import Patch, PatchFinder
from resonator_daemon.decoding.skin import Skin, Wanted

Floats = NDArray[np.float64]


class SurfaceReader(Protocol):
    """Reads frames (3, n) in the order of time."""

    name: str  # what decodes
    shape: tuple[int, ...]  # of the places of its maps, (ny, nx) or (n,)
    physics: ContactDecoder | None

    def read(self, frame: Floats) -> tuple[Decoded, list[Patch]]:
        """Map and patches of a frame."""


class MapReader:
    """By a linear map, with contact physics where that is wanted; its net loads have no bias."""

    def __init__(self, skin: Skin, wanted: Wanted, noise_std: Floats, progress: Callable[[str], None]) -> None:
        sites_m = skin.site_positions_m
        grid = as_grid(sites_m)
        self.name: str = wanted.method
        self.shape: tuple[int, ...] = grid.shape if grid else (len(sites_m),)
        self.physics: ContactDecoder | None = None
        self._linear: OpenPlaneDecoder | FourierDecoder
        progress(f"{wanted.method} decoder of {len(sites_m)} sites")
        if wanted.method == "fourier":
            if grid is None or not np.isclose(grid.pitch_x_m, grid.pitch_y_m):
                raise ValueError(f'method "fourier" needs a square grid, {len(sites_m)} sites form none')
            self._linear = FourierDecoder(
                skin.half_space,
                grid.shape,
                grid.pitch_x_m,
                skin.depth_m,
                noise_std.reshape(3, *grid.shape),
                correlation_length_m=skin.correlation_length_m,
                tangential_ratio=skin.tangential_ratio,
            )
        else:
            self._linear = OpenPlaneDecoder(
                skin.half_space,
                sites_m,
                skin.depth_m,
                noise_std,
                gain_std=skin.gain_std,
                correlation_length_m=skin.correlation_length_m,
                tangential_ratio=skin.tangential_ratio,
            )
            if wanted.contact_physics:
                progress("contact physics")
                self.physics = ContactDecoder(self._linear, wanted.friction_coefficient, background=True)
                self.name += "+contact"
        self._finder = PatchFinder(sites_m, cell_areas_m2(sites_m), skin.depth_m)

    def read(self, frame: Floats) -> tuple[Decoded, list[Patch]]:
        decoded = (self.physics or self._linear).decode(frame.reshape(3, *self.shape), displacement=True)
        patches = self._finder.find(decoded.traction_pascal, decoded.traction_std_pascal)
        if self.physics is not None:
            patches = [with_net_load(patch, self.physics, frame.shape[1]) for patch in patches]
        return decoded, patches


def with_net_load(patch: Patch, physics: ContactDecoder, places: int) -> Patch:
    """Give a patch on a map of so many places the net load that contact physics tells of it, where it tells one."""
    mask = np.zeros(places, np.bool_)
    mask[patch.places] = True
    load = physics.net_load(mask, (0.0, 0.0))
    if load is None:
        return patch
    return replace(
        patch,
        force_newton=load.force_newton,
        force_std_newton=load.force_std_newton,
        moment_newton_m=load.moment_newton_m,
        moment_std_newton_m=load.moment_std_newton_m,
    )


class TemplateReader:
    """By the one contact that explains a frame best."""

    name = "template"
    physics: ContactDecoder | None = None

    def __init__(self, skin: Skin, noise_std: Floats, progress: Callable[[str], None]) -> None:
        self.shape: tuple[int, ...] = (len(skin.site_positions_m),)
        progress(f"template of a contact under {self.shape[0]} sites")
        self._decoder = TemplateDecoder(
            skin.half_space, skin.site_positions_m, skin.depth_m, noise_std, gain_std=skin.gain_std
        )

    def read(self, frame: Floats) -> tuple[Decoded, list[Patch]]:
        decoded, patch = self._decoder.decode_with_patch(frame, displacement=True)
        return decoded, [] if patch is None else [patch]


def surface_reader(skin: Skin, wanted: Wanted, noise_std: Floats, progress: Callable[[str], None]) -> SurfaceReader:
    """Choose by the layout of the sites; ValueError for a skin or a method that cannot be decoded."""
    if wanted.method == "open-plane" and is_sparse(skin.site_positions_m, skin.depth_m):
        return TemplateReader(skin, noise_std, progress)
    return MapReader(skin, wanted, noise_std, progress)
