"""What the stages from the signals of a skin to contacts cost, for `stages.py`: map, constraints, slip, set-up."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from decoding import BODY, DEPTH_M, FRAME_DB, RADIUS_M, SCENES, SIDE, SITES_M, SLIDING, noise_at, signals
from scipy import fft
from scipy.linalg import cho_factor
from stages import Stage, Work

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.surface.contact_physics.decoder import ContactDecoder
from resonator_daemon.estimate.surface.fitting.contact_model import DiscModel
from resonator_daemon.estimate.surface.fitting.partial_slip import ContactStart
from resonator_daemon.estimate.surface.fitting.slip_fitter import SlipWatch
from resonator_daemon.estimate.surface.open_plane.decoder import OpenPlaneDecoder
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.estimate.surface.skin_decoder import SkinDecoder

FRAMES = 64  # of a scene, to and fro
NOISE_STD = 1e-4


@dataclass
class ContactFrames:
    """Map with contact physics, frame after frame; matrices of a moved contact are made at once."""

    decoder: ContactDecoder
    frames: list[Floats]

    def __call__(self) -> None:
        for frame in self.frames:
            self.decoder.decode(frame)
            self.decoder.rebuild()


@dataclass
class SlipFrames:
    """Fit of one contact, frame after frame."""

    watch: SlipWatch
    frames: list[Floats]
    noise_std: Floats
    start: dict[int, ContactStart]

    def __call__(self) -> None:
        for frame in self.frames:
            self.watch.update(frame, self.noise_std, self.start)


def sliding() -> tuple[list[Floats], float]:
    """Return frames of a contact that slides, to and fro, and the standard deviation of their noise."""
    noise, rng = noise_at(FRAME_DB), np.random.default_rng(1)
    way = [signals(SCENES[SLIDING].loads(number)) for number in range(FRAMES // 2)]
    return [each + noise * rng.standard_normal(each.shape) for each in way + way[::-1]], noise


def linear_map() -> Work:
    frames, noise = sliding()
    return Work("", partial(OpenPlaneDecoder(BODY, SITES_M, DEPTH_M, noise).decode, frames[0]))


def constrained_map() -> Work:
    frames, noise = sliding()
    decoder = ContactDecoder(OpenPlaneDecoder(BODY, SITES_M, DEPTH_M, noise), background=True)
    return Work("", ContactFrames(decoder, frames), FRAMES)


def slip() -> Work:
    frames, noise = sliding()
    start = {1: ContactStart((-3e-3, 0.4e-3), RADIUS_M)}
    model = DiscModel(BODY, SITES_M, DEPTH_M, 6e-3)
    return Work("", SlipFrames(SlipWatch(model), frames, np.full((3, SIDE * SIDE), noise), start), FRAMES)


def set_up() -> None:
    noise_std = np.full((3, SIDE * SIDE), NOISE_STD)
    SkinDecoder(Skin(BODY, SITES_M, DEPTH_M), DecodingOptions(), noise_std, lambda _: None)


COUNTABLE = {
    "map, 32 x 32 sites": linear_map,
    "constrained solution in a frame, map included": constrained_map,
    "slip, one contact": slip,
}


def countable() -> dict[str, Work]:
    """Return works that can be pickled, by the names of their stages."""
    return {name: make() for name, make in COUNTABLE.items()}


def stages() -> Iterator[Stage]:
    fields, rows = np.zeros((3, 48, 48), np.float32), np.zeros((8, 3 * SIDE * SIDE), np.float32)
    square, unknowns = np.zeros((516,) * 2, np.float32), np.zeros(516, np.float32)
    limits = (
        Work("scipy.fft of three 48 x 48 fields and back", lambda: fft.irfft2(fft.rfft2(fields), s=(48, 48))),
        Work("numpy, one product with a matrix of 516 unknowns", lambda: square @ unknowns),
        Work("numpy, normal equations of 7 parameters and 3072 signals", lambda: rows @ rows[1:].T),
    )
    for (name, make), limit in zip(COUNTABLE.items(), limits, strict=True):
        yield Stage(name, make(), limit)
    covariance = np.eye(3 * SIDE * SIDE)
    limit = Work("scipy cho_factor of the signals' covariance", lambda: cho_factor(covariance))
    yield Stage("set-up of a decoder, 32 x 32 sites", Work("", set_up), limit)
