"""What `ContactDecoder` is given that it cannot use, or that holds nothing."""

import numpy as np
import pytest
from skin_scenes import NOISE, PITCH_M, SHAPE, SITES, SKIN, noisy, press

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


def test_loads_are_those_of_places_that_are_touched(decoder: ContactDecoder) -> None:
    decoder.reset()
    decoder.decode(noisy(press(centre_m=(1e-3, 0.0)), np.random.default_rng(0)))
    offset_m = SKIN.site_positions_m - [1e-3, 0.0]
    under, far = np.hypot(*offset_m.T) < 6e-4, np.hypot(*offset_m.T) > 4.5e-3
    load, nothing = decoder.net_loads([np.flatnonzero(under), np.flatnonzero(far)], (0.0, 0.0))
    assert load is not None
    assert load.force_newton[2] == pytest.approx(1.0, rel=0.02)
    np.testing.assert_allclose(load.centroid_m, [1e-3, 0.0], atol=3e-5)
    assert nothing is None
    assert decoder.net_loads([np.zeros(0, np.intp)], (0.0, 0.0)) == [None]


def test_a_blob_that_two_contacts_touch_is_divided_between_them(decoder: ContactDecoder) -> None:
    centres_m = (-8e-4, 0.0), (8e-4, 0.0)
    frame = noisy(press(centre_m=centres_m[0]) + press(centre_m=centres_m[1]), np.random.default_rng(0))
    decoder.reset()
    decoder.decode(frame)
    under = [np.flatnonzero(np.hypot(*(SKIN.site_positions_m - centre_m).T) < 6e-4) for centre_m in centres_m]
    whole, *parts = decoder.net_loads([np.concatenate(under)], (0.0, 0.0)) + decoder.net_loads(under, (0.0, 0.0))
    assert whole is not None
    assert whole.force_newton[2] == pytest.approx(2.0, rel=0.02)
    for part in parts:
        assert part is not None
        assert part.force_newton[2] == pytest.approx(1.0, rel=0.1)


def test_it_needs_a_decoder_that_tells_its_sites() -> None:
    fourier = FourierDecoder(SKIN.half_space, SHAPE, PITCH_M, SKIN.depth_m, 1e-3)
    with pytest.raises(ValueError, match="linear_decoder is a FourierDecoder, must be an OpenPlaneDecoder"):
        ContactDecoder(fourier)  # type: ignore[arg-type]
