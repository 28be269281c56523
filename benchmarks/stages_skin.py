"""Stages from the signals of a skin to contacts, for `stages.py`: map, constraints, slip, set-up."""

import itertools
from collections.abc import Iterator
from functools import cache, partial

import numpy as np
from decoding_peers import DenseEstimates, pixel_operator
from decoding_scenes import DEPTH_M, NOISE_STD, PITCH_M, SKIN, contact, frame_of, grid
from elastic_contact import BODY, CURVATURE_RADIUS_M, LOAD_NEWTON, SIDE_M, TOLERANCE, with_tamaas
from frame_cost import SCENES, Load, signals
from scipy import fft
from scipy.linalg import cho_factor
from scipy.optimize import least_squares, nnls
from skin_frames import ContactFrames, SlipFrames
from stage_measure import Growth, Stage, Work

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding import FourierDecoder, OpenPlaneDecoder
from resonator_daemon.decoding.contact_physics.decoder import ContactDecoder
from resonator_daemon.decoding.fitting.contact_model import DiscModel
from resonator_daemon.decoding.fitting.contact_start import ContactStart
from resonator_daemon.decoding.fitting.slip import SlipWatch
from resonator_daemon.decoding.skin import DecodingOptions, Skin
from resonator_daemon.decoding.skin_decoder import SkinDecoder
from resonator_daemon.elastic.contact import press
from resonator_daemon.elastic.influence import SurfaceCompliance, Z
from resonator_daemon.elastic.profiles import paraboloid

SIDE = 32  # of skin32
LEVEL_DB = 30
SLIDING = "sheared, sliding .03 mm a frame"
FRAMES = 64  # of a scene, to and fro
SIDES_OF_SITES = (4, 8, 16, 32)  # 16 to 1024 sites
SIDES = (16, 32, 64, 128)
CONTACT_RADIUS_M = 2.5e-3
MAP = "map, 32 x 32 sites"
CONSTRAINED = "constrained solution in a frame, map included"
HERTZ = "constrained solution, Hertz, 128 x 128"
SLIP = "slip, one contact"


def frame(side: int) -> Floats:
    sites_m = grid(side)
    return frame_of(contact(sites_m, side), sites_m, side, LEVEL_DB, np.random.default_rng(0))[0]


def linear_map(side: int) -> Work:
    decoder, seen = OpenPlaneDecoder(SKIN, grid(side), DEPTH_M, NOISE_STD), frame(side)
    return Work("", partial(decoder.decode, seen))


def transforms(side: int) -> Work:
    fields = np.zeros((3, side, side), np.float32)
    return Work(
        f"scipy.fft of three {side} x {side} fields and back",
        lambda: fft.irfft2(fft.rfft2(fields), s=(side, side)),
    )


def map_stage() -> Stage:
    seen = frame(SIDE)
    single = seen.ravel().astype(np.float32)
    matrix = cache(lambda: DenseEstimates(grid(SIDE), grid(SIDE)).matrix(1.0))
    peer = Work("numpy, product with the exact 3072 x 3072 matrix, scale given", lambda: matrix() @ single)
    return Stage(MAP, linear_map(SIDE), peer, transforms(48))


def sliding(noise_seed: int = 1) -> tuple[list[Floats], float]:
    """Return frames of a contact that slides, to and fro, and the standard deviation of their noise."""
    noise = float(np.sqrt(np.mean(signals([Load((0.0, 0.0), (0.0, 0.0, 1.0))]) ** 2))) * 10.0 ** (-LEVEL_DB / 20.0)
    rng = np.random.default_rng(noise_seed)
    way = [signals(SCENES[SLIDING].loads(number)) for number in range(FRAMES // 2)]
    return [each + noise * rng.standard_normal(each.shape) for each in way + way[::-1]], noise


def constrained_map() -> tuple[Work, list[Floats]]:
    frames, noise = sliding()
    decoder = ContactDecoder(OpenPlaneDecoder(SKIN, grid(SIDE), DEPTH_M, noise), background=True)
    return Work("", ContactFrames(decoder, frames), FRAMES), frames


def constrained_stage() -> Stage:
    work, frames = constrained_map()
    sites_m = grid(SIDE)
    middle_m = np.array([-2.5e-3, 0.4e-3])
    near = np.flatnonzero(np.hypot(*(sites_m - middle_m).T) < 1.2 * CONTACT_RADIUS_M)
    seen = frames[FRAMES // 4].ravel()

    @cache
    def matrix() -> Floats:
        return np.asarray(pixel_operator(sites_m, SIDE).A[:, 2 * SIDE * SIDE + near])

    square = np.zeros((3 * len(near),) * 2, np.float32)
    vector = np.zeros(3 * len(near), np.float32)
    return Stage(
        CONSTRAINED,
        work,
        Work(f"scipy nnls, pressure of {len(near)} given pixels; no shear", lambda: nnls(matrix(), seen)),
        Work(f"numpy, one product with a matrix of {len(vector)} unknowns", lambda: square @ vector),
    )


def hertz(side: int) -> Work:
    compliance = SurfaceCompliance(BODY, (side, side), SIDE_M / side)
    profile = paraboloid((side, side), SIDE_M / side, CURVATURE_RADIUS_M)
    return Work("", partial(press, compliance, profile, load_newton=LOAD_NEWTON, tolerance=TOLERANCE))


def hertz_contact() -> Stage:
    """Compare a Hertz contact on 128 x 128 pixels, to a residual of 1e-8."""
    side = 128
    profile, solve = paraboloid((side, side), SIDE_M / side, CURVATURE_RADIUS_M), with_tamaas(periodic=False)(side)
    depth_by_pressure = SurfaceCompliance(BODY, (side, side), SIDE_M / side).convolution((Z,), (Z,), (side, side))
    pressure = np.full((1, side, side), LOAD_NEWTON)
    return Stage(
        HERTZ,
        hertz(side),
        Work("tamaas, PolonskyKeerRey with dcfft", lambda: solve(profile)),
        Work("one convolution with the influence of a pixel", lambda: depth_by_pressure(pressure)),
    )


def slip_watch(side: int) -> tuple[Work, DiscModel, list[Floats], float]:
    """Return the fit of one contact, frame after frame, on sites of the same area."""
    pick = np.linspace(0, SIDE - 1, side).round().astype(int)
    chosen = np.add.outer(SIDE * pick, pick).ravel()
    frames, noise = sliding()
    model = DiscModel(SKIN, grid(SIDE)[chosen], DEPTH_M, 6e-3)
    frames = [np.ascontiguousarray(each[:, chosen]) for each in frames]
    start = {1: ContactStart((-3e-3, 0.4e-3), CONTACT_RADIUS_M)}
    noise_std = np.full((3, len(chosen)), noise)
    return Work("", SlipFrames(SlipWatch(model), frames, noise_std, start), FRAMES), model, frames, noise


def slip() -> Stage:
    work, model, frames, noise = slip_watch(SIDE)
    coming = itertools.cycle(frames)
    last = np.array([-3e-3, 0.4e-3, CONTACT_RADIUS_M, 0.25, 0.17, 1.0, 0.4])
    low, high = np.array([-1.0, -1.0, 1e-4, -9.0, -9.0, 0.01, 0.0]), np.array([1.0, 1.0, 6e-3, 9.0, 9.0, 9.0, 0.99])

    def peer() -> None:
        target = next(coming).ravel()
        found = least_squares(
            lambda x: (model.slip.signals(x)[0] - target) / noise,
            last,
            lambda x: model.slip.signals(x)[1].T / noise,
            (low, high),
            x_scale="jac",
            ftol=1e-4,
        )
        last[:] = np.clip(found.x, low + 1e-6, high - 1e-6)

    rows = np.zeros((8, 3 * SIDE * SIDE), np.float32)
    return Stage(
        SLIP,
        work,
        Work("scipy least_squares from the frame before, with the same signals and slopes", peer),
        Work("numpy, normal equations of 7 parameters and 3072 signals", lambda: rows @ rows[1:].T),
    )


def set_up(side: int) -> Work:
    skin, noise_std = Skin(SKIN, grid(side), DEPTH_M), np.full((3, side * side), NOISE_STD)
    return Work("", lambda: SkinDecoder(skin, DecodingOptions(), noise_std, lambda _: None))


def set_up_stage() -> Stage:
    sites_m = grid(SIDE)
    covariance = np.eye(3 * SIDE * SIDE)
    return Stage(
        "set-up of a decoder, 32 x 32 sites",
        set_up(SIDE),
        Work("scipy, exact 3072 x 3072 matrix, for one scale", lambda: DenseEstimates(sites_m, sites_m).matrix(1.0)),
        Work("scipy cho_factor of the signals' covariance", lambda: cho_factor(covariance)),
    )


def fourier_map(side: int) -> Work:
    decoder, seen = FourierDecoder(SKIN, (side, side), PITCH_M, DEPTH_M, NOISE_STD), frame(side).reshape(3, side, side)
    return Work("", lambda: decoder.decode(seen))


def stages() -> Iterator[Stage]:
    yield map_stage()
    yield constrained_stage()
    yield hertz_contact()
    yield slip()
    yield set_up_stage()


def countable() -> dict[str, Work]:
    """Return works that can be pickled, by the names of their stages."""
    return {MAP: linear_map(SIDE), CONSTRAINED: constrained_map()[0], HERTZ: hertz(128), SLIP: slip_watch(SIDE)[0]}


def growths() -> Iterator[Growth]:
    sites = tuple(side * side for side in SIDES_OF_SITES)
    side_of = dict(zip(sites, SIDES_OF_SITES, strict=True))
    yield Growth("map", "sites", sites, lambda count: linear_map(side_of[count]))
    yield Growth("slip, one contact", "sites", sites, lambda count: slip_watch(side_of[count])[0])
    yield Growth("set-up of a decoder", "sites", sites, lambda count: set_up(side_of[count]))
    yield Growth("map, Fourier", "grid", SIDES, fourier_map)
    yield Growth("constrained solution, Hertz", "grid", SIDES, hertz)
