"""The third plate: its file, and the emulated tones of its 400 scattered sites."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np

from firmware_protocol.layouts import ToneFlag
from resonator_daemon.plate import Plate, load_plate
from resonator_daemon.sensors.skin_signals import ToneArray
from resonator_daemon.session.compatibility import incompatibilities, oscillator_hz
from simulators.scenario import Scenario, Touch
from simulators.skin_plate import SkinPlate

ROOT = Path(__file__).parents[2]
PLATE = load_plate("fingertip400")
GATE_TICKS = 2_500_000
RECORD = np.dtype("<i4, <i4, <u2, u1, u1")  # phase, offset_hz16, attenuation, sigma_code, flags
PRESS = Touch(start_s=0.0, position_mm=(0.0, 0.0), force_newton=1.0, rise_s=0.0, hold_s=10.0, fall_s=0.0)


def test_the_file_is_what_its_script_makes() -> None:
    run = subprocess.run([sys.executable, ROOT / "docs/plates/fingertip400.py"], capture_output=True, check=True)
    assert run.stdout == (ROOT / "resonator_daemon/plates/fingertip400.toml").read_bytes()


def signals_of(plate: Plate, *touches: Touch, frames: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Mean signals (3, n), as the daemon computes them from the records, and their standard deviation in one frame."""
    emulated = SkinPlate(plate, Scenario(touches, None, plate), seed=4)
    assert incompatibilities(emulated.description, plate) == ()
    counted = emulated.count(0, 250_000_000, GATE_TICKS, frames)
    rows = np.array([[np.frombuffer(channel, RECORD) for channel in frame.channels] for frame in counted])
    assert not (rows["f4"] & ToneFlag.OUT_OF_BAND).any()
    tones = plate.tones
    assert plate.skin
    array = ToneArray(
        tones.f0_hz,
        tones.sensitivity,
        oscillator_hz(emulated.description),
        tones.site_index,
        tones.signal_index,
        plate.skin.youngs_modulus_pascal,
    )
    sigma_hz = 2.0 ** ((rows["f3"][0] - 128.0) / 8.0)
    shifts = array.shifts(rows["f1"].mean(axis=0) / 2**16, sigma_hz**2)
    return array.signals(shifts, common_mode=-1.5e-6 / (1.0 + 1.5e-6))


def test_each_sites_signals_are_those_of_its_own_place() -> None:
    """Beside point loads strewn over the Hertz disc (Boussinesq's solution; Johnson, Contact Mechanics, 3.2)."""
    signals, noise_std = signals_of(PLATE, PRESS)
    angle, ring = np.meshgrid(np.arange(48) * (2 * math.pi / 48), (np.arange(60) + 0.5) / 60)
    share = (ring * np.sqrt(1.0 - ring**2)).ravel()
    loads_m = 2.5e-3 * np.column_stack([(ring * np.cos(angle)).ravel(), (ring * np.sin(angle)).ravel()])
    away = PLATE.site_positions_m[:, np.newaxis] - loads_m
    rho = np.sqrt((away**2).sum(axis=-1) + 1e-6)
    p_n = -1.5 / (3 * math.pi) * (1e-3 / rho**3) @ share / share.sum()
    shear = -3 / (2 * math.pi) * np.einsum("nl,nli,l->in", 1e-6 / rho**5, away, share) / share.sum()
    true = 1.5 / 2e5 * np.array([p_n, *shear])
    # 40 frames' noise, and a gain that is off by 1 % and not told
    assert (np.abs(signals - true) < 5.0 * np.hypot(noise_std / math.sqrt(40), 0.011 * np.abs(true))).all()
