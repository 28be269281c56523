"""Make tamaas_rough_contact.npz: pressure between a random rough rigid surface and a periodic half-space, by tamaas.

Run in an environment of its own, which need not know this project (made with tamaas 2.9.0 and numpy 2.4.6):

    python -m venv peer && peer/bin/pip install tamaas
    peer/bin/python tests/elastic/references/make_tamaas_rough_contact.py

The solver is that of Polonsky, Keer and Rey, with a mean pressure. tamaas' surface is an elevation towards the body;
the profile stored is its negative. Lengths are in units of the period, pressures in those of E / (1 - nu^2).
"""

from pathlib import Path

import numpy as np
import tamaas

COUNT = 36
MEAN_PRESSURES = [0.002, 0.02, 0.06]


def rough_profile(rng: np.random.Generator) -> np.ndarray:
    """Self-affine profile (COUNT, COUNT) of rms 0.01, with waves of 2 to 12 to the period."""
    waves = COUNT * np.hypot(np.fft.rfftfreq(COUNT), np.fft.fftfreq(COUNT)[:, None])
    amplitude = np.where((waves >= 2) & (waves <= 12), np.maximum(waves, 1.0) ** -1.8, 0.0)
    profile = np.fft.irfft2(amplitude * np.fft.rfft2(rng.standard_normal((COUNT, COUNT))), s=(COUNT, COUNT))
    return profile * 0.01 / profile.std()


def pressure(profile: np.ndarray, mean_pressure: float) -> np.ndarray:
    model = tamaas.Model(tamaas.model_type.basic_2d, [1.0, 1.0], [COUNT, COUNT])
    model.E, model.nu = 1.0, 0.0
    solver = tamaas.PolonskyKeerRey(model, -profile, 1e-13)
    solver.max_iter = 10_000
    solver.solve(mean_pressure)
    return np.array(model.traction)


if __name__ == "__main__":
    tamaas.set_log_level(tamaas.LogLevel.error)
    profile = rough_profile(np.random.default_rng(7))
    np.savez_compressed(
        Path(__file__).with_name("tamaas_rough_contact.npz"),
        made_with=f"tamaas {tamaas.__version__}, numpy {np.__version__}",
        profile=profile,
        mean_pressure=MEAN_PRESSURES,
        pressure=np.stack([pressure(profile, mean_pressure) for mean_pressure in MEAN_PRESSURES]),
    )
