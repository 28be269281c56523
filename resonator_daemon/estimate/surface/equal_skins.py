"""Decoders of many skins: those of equal skins share their matrices; each has its own state."""

import pickle
from collections.abc import Callable
from weakref import WeakKeyDictionary

from resonator_daemon.base.arrays import Floats
from resonator_daemon.estimate.surface.skin import DecodingOptions, Skin
from resonator_daemon.estimate.surface.skin_decoder import SkinDecoder
from resonator_daemon.estimate.surface.streaming import set_up


class _Matrices:
    """Read-only arrays of a decoder that has not decoded yet."""

    def __init__(self, skin: Skin, options: DecodingOptions, decoder: SkinDecoder) -> None:
        self._geometry, self._options, self._decoder = skin.geometry(), options, decoder
        arrays: list[pickle.PickleBuffer] = []
        self._rest = pickle.dumps(decoder, protocol=5, buffer_callback=arrays.append)
        self._arrays = [array.raw().toreadonly() for array in arrays]

    def match(self, skin: Skin, options: DecodingOptions, noise_std: Floats) -> bool:
        """Return whether a decoder with these matrices decodes signals of such noise, (3, n), under a skin."""
        return skin.geometry() == self._geometry and options == self._options and bool(self._decoder.fits(noise_std))

    def decoder(self) -> SkinDecoder:
        """Return another decoder with these matrices, in its initial state."""
        decoder: SkinDecoder = pickle.loads(self._rest, buffers=self._arrays)
        return decoder


class EqualSkins:
    """Set-up of decoders whose matrices equal skins share; matrices are released with the last decoder that has them.

    A decoder returns the same values as one that is alone, if both were set up for the same noise.
    """

    def __init__(self) -> None:
        self._matrices: WeakKeyDictionary[SkinDecoder, _Matrices] = WeakKeyDictionary()

    def set_up(
        self, skin: Skin, options: DecodingOptions, noise_std: Floats, progress: Callable[[str], None]
    ) -> SkinDecoder:
        """Return a decoder with the matrices of an equal skin of similar noise; without one, as `streaming.set_up`."""
        known = (each for each in list(self._matrices.values()) if each.match(skin, options, noise_std))
        matrices = next(known, None) or _Matrices(skin, options, set_up(skin, options, noise_std, progress))
        decoder = matrices.decoder()
        self._matrices[decoder] = matrices
        return decoder
