"""What the tests of the streaming decoder share: a small skin, and a decoder in place of the real one."""

from collections.abc import Callable

import numpy as np
from contact_scenes import DEPTH_M, NU, E, grid_positions
from skin_scenes import noisy, press

from resonator_daemon.arrays import Floats
from resonator_daemon.decoding import Decoded
from resonator_daemon.decoding.skin import DecodingOptions, Skin
from resonator_daemon.decoding.skin_contacts import SkinEvent
from resonator_daemon.decoding.skin_decoder import SurfaceReading
from resonator_daemon.elastic import HalfSpace

SHAPE, SITES = (12, 12), 144
SKIN = Skin(HalfSpace(E, NU), grid_positions(SHAPE), DEPTH_M)
NOISE = np.tile([[2.0**-7], [2.0**-8], [2.0**-8]], SITES)  # powers of two, which rounding keeps
NOTHING = np.zeros((3, SITES))
LINEAR = DecodingOptions(contact_physics=False)
NAN = np.nan


class SubstituteDecoder:
    """In the place of the real one: knows its noise, and answers with the first signal as chi2."""

    name, shape = "substitute", (SITES,)

    def __init__(self, skin: Skin, wanted: DecodingOptions, noise_std: Floats, progress: Callable[[str], None]) -> None:
        self.built_for = noise_std

    def fits(self, noise_std: Floats) -> bool:
        return bool(noise_std[0, 0] == self.built_for[0, 0])

    def decode_map(self, signals: Floats, noise_std: Floats) -> Decoded:
        return Decoded(signals, signals, None, False, 0.0, float(signals[0, 0]), "ok", "")

    def read_contacts(self, decoded: Decoded) -> SurfaceReading:
        return SurfaceReading(self.name, decoded)

    def succeed(self, other: "SubstituteDecoder") -> tuple[SkinEvent, ...]:
        return ()

    def rebuild(self) -> bool:
        return False


def pressed(seed: int = 0) -> Floats:
    """A frame of 1 N with some shear in the middle."""
    signals = press(shear_newton=(0.3, 0.0), sites_m=SKIN.site_positions_m)
    return noisy(signals, np.random.default_rng(seed), NOISE)


def marked(value: float) -> Floats:
    return np.full((3, SITES), value)
