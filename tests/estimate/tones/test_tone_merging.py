import numpy as np
import pytest

from resonator_daemon.estimate.tones.tone_merging import merge_tones

GATE_S, SAMPLES, NOISE_TURN = 0.004, 400, 0.01
WITHIN_S = (np.arange(SAMPLES) + 0.5) * GATE_S / SAMPLES


def slopes(times_s, turns):
    """Least-squares slope along axis 0 of turns (n, ...)."""
    return np.polyfit(times_s, turns.reshape(len(times_s), -1), 1)[0].reshape(turns.shape[1:])


GATE_SIGMA_HZ = NOISE_TURN / np.sqrt(np.sum((WITHIN_S - WITHIN_S.mean()) ** 2))


def wrapped32(turns):
    return np.rint(turns % 1.0 * 2.0**32).astype(np.int64).astype(np.int32)  # a whole turn and the sign fall out


def records(turns):
    """Mid-phase and slope of each gate as the wire has them, from phase samples (k, SAMPLES, ...)."""
    slope_hz = np.stack([slopes(WITHIN_S, gate) for gate in turns])
    return wrapped32(turns.mean(axis=1)), np.rint(slope_hz * 65536).astype(np.int32)


def phase_samples(rng, gates, offset_hz, noise_turn=NOISE_TURN):
    """Phase (gates, SAMPLES, *tones) of steady tones with white phase noise."""
    times_s = np.arange(gates)[:, None] * GATE_S + WITHIN_S
    turns = np.multiply.outer(times_s, offset_hz) + rng.random(offset_hz.shape)
    return turns + rng.normal(0, noise_turn, turns.shape) if noise_turn else turns


def merged(turns, known=None, sigma_hz=None):
    phase, offset = records(turns)
    known = np.ones(phase.shape, bool) if known is None else known
    sigma_hz = np.full(phase.shape, GATE_SIGMA_HZ) if sigma_hz is None else sigma_hz
    return merge_tones(phase, offset, sigma_hz, known, GATE_S)


def offsets_hz(rng, *shape):
    return rng.uniform(-32_000, 32_000, shape)  # over a hundred turns a gate


@pytest.mark.parametrize("gates", [2, 5, 10])
def test_merged_gates_equal_the_regression_over_all_their_phase_samples(gates):
    rng = np.random.default_rng(gates)
    turns = phase_samples(rng, gates, offsets_hz(rng, 4, 30))
    times_s = (np.arange(gates)[:, None] * GATE_S + WITHIN_S).ravel()
    whole_hz = slopes(times_s, turns.reshape(-1, 4, 30))
    tones = merged(turns)
    # Of a gate of n samples both keep 1 - 1/n^2; offsets are whole 2^-16 Hz.
    assert np.abs(tones.offset_hz - whole_hz).max() < 1e-3 * GATE_SIGMA_HZ * gates**-1.5
    np.testing.assert_allclose(tones.sigma_hz, GATE_SIGMA_HZ * gates**-1.5, rtol=1e-12)
    assert not tones.resync.any()


def test_spread_of_merged_gates_is_the_stated_one_and_that_of_their_mean_ten_times_larger():
    rng = np.random.default_rng(3)
    gates, tones, offset_hz = 10, 40_000, 1234.5
    # Slopes and mid-phases of white phase noise, drawn as such.
    slope = offset_hz + GATE_SIGMA_HZ * rng.standard_normal((gates, tones))
    middle = offset_hz * GATE_S * np.arange(gates)[:, None] + GATE_SIGMA_HZ * GATE_S / np.sqrt(
        12
    ) * rng.standard_normal((gates, tones))
    phase, offset = wrapped32(middle), np.rint(slope * 65536).astype(np.int32)
    found = merge_tones(phase, offset, np.full(phase.shape, GATE_SIGMA_HZ), np.ones(phase.shape, bool), GATE_S)
    assert found.offset_hz.mean() == pytest.approx(offset_hz, abs=4 * found.sigma_hz[0] / np.sqrt(tones))
    assert found.offset_hz.std() == pytest.approx(found.sigma_hz[0], rel=0.015)
    assert slope.mean(axis=0).std() / found.offset_hz.std() == pytest.approx(10, rel=0.02)
    assert not found.resync.any()


def test_gates_weigh_by_their_noise():
    rng = np.random.default_rng(4)
    noise = NOISE_TURN * np.array([1, 1, 4, 1, 8, 1])[:, None, None]
    offset_hz = offsets_hz(rng, 200)
    turns = phase_samples(rng, 6, offset_hz, 0) + noise * rng.standard_normal((6, SAMPLES, 200))
    sigma_hz = np.broadcast_to(GATE_SIGMA_HZ * noise[:, 0] / NOISE_TURN, (6, 200))
    tones = merged(turns, sigma_hz=sigma_hz)
    times_s = (np.arange(6)[:, None] * GATE_S + WITHIN_S).ravel()
    weights = np.repeat(1 / noise.ravel(), SAMPLES)
    fit, covariance = np.polyfit(times_s, turns.reshape(-1, 200), 1, w=weights, cov="unscaled")
    assert np.abs(tones.offset_hz - fit[0]).max() < 2e-3 * tones.sigma_hz[0]
    np.testing.assert_allclose(tones.sigma_hz, np.sqrt(covariance[0, 0].item()), rtol=1e-4)


def test_the_phase_runs_on_across_gates_that_are_not_known():
    rng = np.random.default_rng(5)
    turns = phase_samples(rng, 7, offsets_hz(rng, 100))
    known = np.ones((7, 100), bool)
    known[[0, 3, 4]] = False
    phase, offset = records(turns)
    phase[~known], offset[~known] = 12345, 2**31 - 1
    tones = merge_tones(phase, offset, np.where(known, GATE_SIGMA_HZ, 1e-9), known, GATE_S)
    times_s = (np.array([1, 2, 5, 6])[:, None] * GATE_S + WITHIN_S).ravel()
    whole_hz = slopes(times_s, turns[[1, 2, 5, 6]].reshape(-1, 100))
    assert np.abs(tones.offset_hz - whole_hz).max() < 2e-3 * tones.sigma_hz[0]
    assert not tones.resync.any()


def test_one_known_gate_is_itself_and_none_is_not_a_number():
    rng = np.random.default_rng(6)
    turns = phase_samples(rng, 3, offsets_hz(rng, 2))
    tones = merged(turns, known=np.array([[False, False], [True, False], [False, False]]))
    assert tones.offset_hz[0] == records(turns)[1][1, 0] / 65536
    assert tones.sigma_hz[0] == pytest.approx(GATE_SIGMA_HZ, rel=1e-15)
    assert np.isnan([tones.offset_hz[1], tones.sigma_hz[1]]).all()
    assert not tones.resync.any()


@pytest.mark.parametrize("jump_turn", [0.02, -0.3, 0.49])
def test_a_phase_that_jumps_is_a_resync_of_that_tone_alone(jump_turn):
    rng = np.random.default_rng(7)
    offset_hz = offsets_hz(rng, 50)
    turns = phase_samples(rng, 8, offset_hz, NOISE_TURN)
    turns[5:, :, 7] += jump_turn
    tones = merged(turns)
    assert np.flatnonzero(tones.resync).tolist() == [7]
    assert tones.offset_hz[7] == pytest.approx((records(turns)[1][:, 7] / 65536).mean(), rel=1e-12)
    assert tones.sigma_hz[7] == pytest.approx(GATE_SIGMA_HZ / np.sqrt(8), rel=1e-12)
    assert np.abs(np.delete(tones.offset_hz - offset_hz, 7)).max() < 5 * GATE_SIGMA_HZ * 8**-1.5


def test_a_quarter_turn_off_is_a_resync_whatever_the_noise():
    turns = phase_samples(np.random.default_rng(9), 4, np.array([100.0, 200.0]), 0)
    turns[2:, :, 0] += 0.24
    turns[2:, :, 1] += 0.26
    # Six standard deviations of what a phase may be off its prediction, sqrt(2/3) s T, are 0.4 turns.
    sigma_hz = np.full((4, 2), 0.4 / 6 / np.sqrt(2 / 3) / GATE_S)
    assert merged(turns, sigma_hz=sigma_hz).resync.tolist() == [False, True]


def test_noise_that_leaves_the_count_of_turns_in_doubt_is_a_resync():
    rng = np.random.default_rng(8)
    turns = phase_samples(rng, 4, offsets_hz(rng, 10))
    sigma_hz = np.full((4, 10), GATE_SIGMA_HZ)
    sigma_hz[2, 3] = 0.25 / GATE_S
    assert np.flatnonzero(merged(turns, sigma_hz=sigma_hz).resync).tolist() == [3]


@pytest.mark.parametrize("swing_hz", [5.0, 50.0, 500.0])
def test_a_tone_that_a_press_moves_is_no_resync(swing_hz):
    """Offset as the sine of a press of 50 ms; the merged offset is the weighted mean that a regression makes of it."""
    gates, low_noise = 5, 0.01
    for phase in np.linspace(0, 2 * np.pi, 24, endpoint=False):
        times_s = np.arange(gates)[:, None] * GATE_S + WITHIN_S
        rate = 2 * np.pi / 0.1
        turns = (1000 * times_s - swing_hz / rate * np.cos(rate * times_s + phase))[..., None]
        tones = merged(turns, sigma_hz=np.full((gates, 1), low_noise))
        assert not tones.resync.any()
        assert tones.offset_hz[0] == pytest.approx(
            slopes(times_s.ravel(), turns.reshape(-1, 1))[0], abs=2e-5 * swing_hz
        )
