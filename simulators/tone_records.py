"""Tones as a channelised counter sends them: evenly spaced oscillators, and the records of offsets against these."""

import numpy as np
import numpy.typing as npt

from firmware_protocol.layouts import TONE_FIELDS, ToneFlag
from resonator_daemon.base.plate import Plate
from simulators.arrays import Floats
from simulators.plate import record_type

_TONE = record_type(TONE_FIELDS)
_OUT_OF_BAND = np.uint8(ToneFlag.OUT_OF_BAND)
# The last of a double's 52 binary places is worth 2^-32 or 2^-16 in a sum with these: adding one rounds to the wire's
# unit, half to even, and leaves the rounded number in the low 32 bits of the sum, modulo 2^32.
_TO_TURN32, _TO_HZ16 = 1.5 * 2.0 ** (52 - 32), 1.5 * 2.0 ** (52 - 16)


def even_oscillators(plate: Plate) -> tuple[Floats, float]:
    """Return the frequencies (tones,) that tones are counted against, evenly spaced, and their spacing."""
    f0_hz = plate.tones.f0_hz.mean(axis=1)
    spacing_hz = float(f0_hz[-1] - f0_hz[0]) / max(len(f0_hz) - 1, 1)
    oscillator_hz = f0_hz[0] + spacing_hz * np.arange(len(f0_hz))
    off_hz = np.abs(plate.tones.f0_hz - oscillator_hz[:, np.newaxis]).max()
    if not off_hz < abs(spacing_hz) / 2.0:
        raise ValueError(
            f"tones of plate {plate.name} lie up to {off_hz:.0f} Hz off an even spacing of {spacing_hz:.0f} Hz, must "
            "be within half of it, in the order of the file: the emulated counter's oscillators are spaced evenly"
        )
    return oscillator_hz, spacing_hz


class ToneRecords:
    """Records of the tones on every channel, of gates of one length.

    Parameters
    ----------
    sigma_hz
        Standard deviation (channels, tones) of the offset.
    attenuation_db256
        Level (channels, tones) below full scale in 1/256 dB.
    half_spacing_hz
        Offset beyond which a tone is out of its band.
    """

    def __init__(self, sigma_hz: Floats, attenuation_db256: npt.NDArray[np.uint16], half_spacing_hz: float) -> None:
        self._half_spacing_hz = half_spacing_hz
        self._records = np.zeros(sigma_hz.shape, dtype=_TONE)
        self._rounded = np.empty(sigma_hz.shape)
        self._records["attenuation_db256"] = attenuation_db256
        self._records["sigma_code"] = np.clip(np.rint(128.0 + 8.0 * np.log2(sigma_hz)), 0, 255)

    def gate(self, offset_hz: Floats, middle_turns: Floats) -> list[bytes]:
        """Return the records of each channel in one gate.

        Parameters
        ----------
        offset_hz
            Against the tone's oscillator (channels, tones), noise included.
        middle_turns
            Phase (channels, tones) against it in the middle of the gate; whole turns do not matter.
        """
        records, rounded = self._records, self._rounded
        np.add(middle_turns, _TO_TURN32, out=rounded)
        records["phase_turn32"] = rounded.view(np.int64)  # modulo a turn
        np.add(offset_hz, _TO_HZ16, out=rounded)
        records["offset_hz16"] = rounded.view(np.int64)
        beyond = np.abs(offset_hz, out=rounded) > self._half_spacing_hz
        records["flags"] = beyond * _OUT_OF_BAND if beyond.any() else 0
        return [channel.tobytes() for channel in records]
