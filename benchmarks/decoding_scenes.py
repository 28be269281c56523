"""Layouts of sites, and contacts above them in closed form, that the tables of the decoders share."""

from collections.abc import Callable

import numpy as np

from resonator_daemon.arrays import Floats
from resonator_daemon.elastic import HalfSpace
from simulators.contact import pixel_tractions
from simulators.half_space_fields import hertz_fields

Scene = tuple[Floats, Floats]  # signals (3, n) without noise, traction (3, side * side)

PITCH_M, DEPTH_M, YOUNGS_PASCAL, FRICTION = 4e-4, 1e-3, 2e5, 0.5
RADIUS_M, STICK_RATIO = 2.5e-3, 0.5
SKIN = HalfSpace(YOUNGS_PASCAL, 0.5)
NOISE_STD = 1e-4  # the same in all frames, which are scaled to reach a ratio: one set-up serves all levels
LEVELS_DB = (11, 20, 30, 40)


def grid(side: int) -> Floats:
    axis = (np.arange(side) - (side - 1) / 2) * PITCH_M
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def layouts(side: int) -> dict[str, Floats]:
    """Places of about as many sites on one square: regular, hexagonal, random."""
    half_m = side * PITCH_M / 2
    x, y = np.meshgrid(np.arange(side + 1), np.arange(round(side / np.sqrt(0.75)) + 1))
    hexagons = np.column_stack([(x + y % 2 / 2).ravel(), (y * np.sqrt(0.75)).ravel()]) * PITCH_M - half_m
    inside = (np.abs(hexagons) < half_m).all(axis=1)
    random = np.random.default_rng(0).uniform(-half_m, half_m, (side * side, 2))
    return {"grid": grid(side), "hexagonal": hexagons[inside], "random": random}


def contact(
    sites_m: Floats,
    side: int,
    centre_m: tuple[float, float] = (0.0, 0.0),
    radius_m: float = RADIUS_M,
    stick_ratio: float = STICK_RATIO,
    direction: float = 0.0,
) -> Scene:
    """Cattaneo-Mindlin contact under 1 N; its traction averaged over the pixels of a grid."""
    along = np.array([np.cos(direction), np.sin(direction), 0.0])
    sliding, normal = FRICTION * along, np.array([0.0, 0.0, 1.0])
    parts = hertz_fields(sites_m - centre_m, DEPTH_M, [radius_m, stick_ratio * radius_m], YOUNGS_PASCAL, 0.5)
    signals = np.tensordot(sliding + normal, parts[0], (0, 0)) - np.tensordot(
        stick_ratio**3 * sliding, parts[1], (0, 0)
    )
    force = (1.0 - stick_ratio**3) * sliding + normal
    traction = pixel_tractions(force, centre_m, radius_m, FRICTION, (side, side), PITCH_M)
    return signals * [[1.5 / YOUNGS_PASCAL], [1.0], [1.0]], traction.reshape(3, -1)


def random_contact(sites_m: Floats, side: int, rng: np.random.Generator) -> Scene:
    reach_m = side * PITCH_M / 2 - 3.4e-3
    x, y = rng.uniform(-reach_m, reach_m, 2)
    radius_m, ratio, direction = rng.uniform([1.5e-3, 0.2, 0.0], [3e-3, 0.9, 2.0 * np.pi])
    return contact(sites_m, side, (x, y), radius_m, ratio, direction)


def together(one: Scene, other: Scene) -> Scene:
    return one[0] + other[0], one[1] + other[1]


def beyond_border(distance_m: float) -> Callable[[Floats, int, np.random.Generator], Scene]:
    """Place a contact on the x axis, so far outside the square of the sites."""
    return lambda sites_m, side, _: contact(sites_m, side, (side * PITCH_M / 2 + distance_m, 0.0))


SCENES: dict[str, Callable[[Floats, int, np.random.Generator], Scene]] = {
    "centred": lambda sites_m, side, _: contact(sites_m, side),
    "border": beyond_border(-0.9e-3),
    "across": beyond_border(0.0),
    "outside": beyond_border(1.6e-3),
    "two": lambda *where: together(contact(*where[:2]), beyond_border(3.1e-3)(*where)),
    "random": random_contact,
}


def frame_of(scene: Scene, sites_m: Floats, side: int, decibel: float, rng: np.random.Generator) -> Scene:
    """Scaled so that the centred contact would have a ratio of total rms to noise, with noise."""
    signals, traction = scene
    centred_rms = np.sqrt(np.mean(contact(sites_m, side)[0] ** 2))
    scale = NOISE_STD * 10 ** (decibel / 20) / float(centred_rms)
    return scale * signals + NOISE_STD * rng.standard_normal(signals.shape), scale * traction


def error(found: Floats, expected: Floats) -> float:
    """Relative L2 error."""
    return float(np.linalg.norm(found.reshape(3, -1) - expected) / np.linalg.norm(expected))
