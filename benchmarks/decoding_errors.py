"""Errors of the linear decoders by scene, layout and noise, and with wrong gains; honesty of error bars."""

from collections.abc import Callable, Mapping

import numpy as np
from decoding_peers import printed_recipe
from decoding_scenes import (
    DEPTH_M,
    LEVELS_DB,
    NOISE_STD,
    PITCH_M,
    SCENES,
    SKIN,
    Floats,
    Scene,
    contact,
    error,
    frame_of,
    grid,
    random_contact,
)

from resonator_daemon.decoding import FourierDecoder, OpenPlaneDecoder
from resonator_daemon.decoding.prior import Prior

SIDE = 32
SITES_M = grid(SIDE)
Estimate = Callable[[Floats, Floats], Floats]  # of signals (3, n); the truth serves the printed recipe alone


def on_grid(side: int) -> dict[str, Estimate]:
    """Estimates that need a grid."""
    fourier = FourierDecoder(SKIN, (side, side), PITCH_M, DEPTH_M, NOISE_STD)
    return {
        "Fourier": lambda frame, _: fourier.decode(frame.reshape(3, side, side)).traction_pascal,
        "printed recipe": lambda frame, truth: printed_recipe(side, float(np.sqrt(np.mean(truth**2))))(frame),
    }


def equal_powers() -> Estimate:
    """Return the open-plane estimate under a prior of equal power of all components."""
    return open_plane(OpenPlaneDecoder(SKIN, SITES_M, DEPTH_M, NOISE_STD, prior=Prior(tangential_ratio=1.0)))


def open_plane(decoder: OpenPlaneDecoder) -> Estimate:
    return lambda frame, _: decoder.decode(frame).traction_pascal


def by_scene(layout: str, sites_m: Floats, side: int, estimates: Mapping[str, Estimate], draws: int) -> None:
    """Print a row for each estimate and scene."""
    for name, estimate in estimates.items():
        for scene, make in SCENES.items():
            row = []
            for level in LEVELS_DB:
                rng = np.random.default_rng(1)
                frames = [frame_of(make(sites_m, side, rng), sites_m, side, level, rng) for _ in range(draws)]
                row.append(np.mean([error(estimate(frame, truth), truth) for frame, truth in frames]))
            cells = (f"{value:8.3f}" for value in row)
            print(f"{layout:10} {len(sites_m):5} {name:24} {scene:8}", *cells, flush=True)


def wrong_gains(linear: OpenPlaneDecoder, draws: int) -> None:
    """Print errors on the centred contact, of a decoder told the spread of the gains and of one that is not."""
    scene = contact(SITES_M, SIDE)
    print(f"\n{'open-plane, centred':34}", *(f"{level:>5} dB" for level in LEVELS_DB))
    for gain_std in (0.02, 0.05):
        told = OpenPlaneDecoder(SKIN, SITES_M, DEPTH_M, NOISE_STD, gain_std=gain_std)
        for name, decoder in (("gain_std told", told), ("not told", linear)):
            row = []
            for level in LEVELS_DB:
                rng = np.random.default_rng(3)
                frames = [wrong_gain(scene, level, gain_std, rng) for _ in range(draws)]
                row.append(np.mean([error(decoder.decode(frame).traction_pascal, truth) for frame, truth in frames]))
            cells = (f"{value:8.3f}" for value in row)
            print(f"gains wrong by {gain_std:.0%}, {name:18}", *cells)


def wrong_gain(scene: Scene, level: float, gain_std: float, rng: np.random.Generator) -> Scene:
    signals, truth = scene
    gained = signals * (1.0 + gain_std * rng.standard_normal(signals.shape))
    return frame_of((gained, truth), SITES_M, SIDE, level, rng)


def honesty(linear: OpenPlaneDecoder, draws: int) -> None:
    print("\nopen-plane, random contacts: share within 1 and 2 sd, inside and outside contact; chi2")
    for level in LEVELS_DB:
        rng = np.random.default_rng(4)
        rows = []
        for _ in range(draws):
            frame, truth = frame_of(random_contact(SITES_M, SIDE, rng), SITES_M, SIDE, level, rng)
            found = linear.decode(frame)
            sigmas = np.abs(found.traction_pascal - truth) / found.traction_std_pascal
            pressed = truth[2] > 1e-9 * truth[2].max()
            inside = [np.mean(sigmas[:, area] < limit) for area in (pressed, ~pressed) for limit in (1.0, 2.0)]
            rows.append([*inside, float(found.chi2)])
        print(f"{level:3} dB", *(f"{value:6.2f}" for value in np.mean(rows, axis=0)))
