"""What `ContactDecoder` is given that it cannot use, or that holds nothing."""

import numpy as np
import pytest
from skin_scenes import NOISE, PITCH_M, SHAPE, SITES, SKIN

from resonator_daemon.decoding import ContactDecoder, FourierDecoder, OpenPlaneDecoder


@pytest.fixture(scope="module")
def decoder() -> ContactDecoder:
    return ContactDecoder(OpenPlaneDecoder(SKIN.half_space, SKIN.site_positions_m, SKIN.depth_m, NOISE))


def test_an_empty_stack_gives_an_empty_stack(decoder: ContactDecoder) -> None:
    decoded = decoder.decode(np.zeros((0, 3, SITES)), displacement=True)
    assert decoded.traction_pascal.shape == (0, 3, SITES)
    assert decoded.status.shape == (0,)
    with pytest.raises(ValueError, match="signals have shape"):
        decoder.decode(np.zeros((0, 3, SITES + 1)))


def test_it_needs_a_decoder_that_tells_its_sites() -> None:
    fourier = FourierDecoder(SKIN.half_space, SHAPE, PITCH_M, SKIN.depth_m, 1e-3)
    with pytest.raises(ValueError, match="linear_decoder is a FourierDecoder, must be an OpenPlaneDecoder"):
        ContactDecoder(fourier)  # type: ignore[arg-type]
