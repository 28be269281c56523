"""Make tamaas_fields.npz: periodic fields of a random traction inside a half-space, by the program tamaas.

Run in an environment of its own, which need not know this project (made with tamaas 2.9.0 and numpy 2.4.6):

    python -m venv peer && peer/bin/pip install tamaas && peer/bin/python tests/elastic/references/make_tamaas_fields.py

The traction holds neither a mean, whose fields depend on a choice, nor Nyquist frequencies, whose odd terms tamaas
keeps. tamaas' surface has x first and components last, and its shears are sqrt(2) times the tensor's; here arrays
are (..., y, x) with the components xx, yy, zz, xy, xz, yz of tensors before them. Signs are those of tamaas: the
traction acts on the body, whose depth is z. It has no value at nu = 1/2, where its Lame constant is infinite.
"""

from pathlib import Path

import numpy as np
import tamaas

from resonator_daemon.arrays import Floats

SHAPE, PITCH_M = (12, 16), 4e-4  # (ny, nx): the two axes differ
YOUNGS_MODULUS_PASCAL = 2e5
POISSON_RATIOS = [0.0, 0.3, 0.49]
PLANES, DEPTH_STEP_M = 4, 5e-4
KEPT = [1, 2, 3]  # planes inside the body; that at depth 0 is kept as the surface displacement alone


def random_traction(rng: np.random.Generator) -> Floats:
    """Field (3, ny, nx) of some kilopascals without mean and without Nyquist frequencies."""
    ny, nx = SHAPE
    spectrum = np.fft.rfft2(rng.standard_normal((3, ny, nx)))
    spectrum[:, 0, 0] = 0.0
    spectrum[:, ny // 2] = 0.0
    spectrum[:, :, nx // 2] = 0.0
    return np.fft.irfft2(spectrum, s=SHAPE) * 1e3


def images_first(field: Floats) -> Floats:
    """Turn (..., x, y, component) of tamaas into (..., component, y, x)."""
    return np.ascontiguousarray(np.moveaxis(field, [-1, -2, -3], [-3, -2, -1]))


def make_model(kind: tamaas.model_type, poisson_ratio: float, traction: Floats) -> tamaas.Model:
    """Model of the surface, or of the volume below, under the traction."""
    ny, nx = SHAPE
    size, count = [nx * PITCH_M, ny * PITCH_M], [nx, ny]
    if kind == tamaas.model_type.volume_2d:
        size, count = [(PLANES - 1) * DEPTH_STEP_M, *size], [PLANES, *count]
    model = tamaas.Model(kind, size, count)
    model.E, model.nu = YOUNGS_MODULUS_PASCAL, poisson_ratio
    model.traction[...] = traction.transpose(2, 1, 0)
    return model


def surface_displacement(poisson_ratio: float, traction: Floats) -> Floats:
    """Displacement (3, ny, nx) of the surface."""
    model = make_model(tamaas.model_type.surface_2d, poisson_ratio, traction)
    model.solveNeumann()
    return images_first(np.array(model.displacement))


def inner_fields(poisson_ratio: float, traction: Floats) -> dict[str, Floats]:
    """Fields (depths, rows, ny, nx) inside."""
    model = make_model(tamaas.model_type.volume_2d, poisson_ratio, traction)
    tamaas.ModelFactory.registerVolumeOperators(model)
    displacement = np.zeros_like(model.displacement)
    strain = np.zeros((*displacement.shape[:-1], 6))
    stress = np.zeros_like(strain)
    surface_traction = np.array(model.traction)
    model.operators["boussinesq"](surface_traction, displacement)
    model.operators["boussinesq_gradient"](surface_traction, strain)
    model.operators["hooke"](strain, stress)
    for tensor in (strain, stress):
        tensor[..., 3:] /= np.sqrt(2.0)
    return {
        "displacement": images_first(displacement)[KEPT],
        "strain": images_first(strain)[KEPT],
        "stress": images_first(stress)[KEPT],
        "p_n": images_first(stress)[KEPT, :3].mean(axis=1, keepdims=True),
    }


if __name__ == "__main__":
    tamaas.set_log_level(tamaas.LogLevel.error)
    traction = random_traction(np.random.default_rng(20))
    of_each_body = [
        {"surface_displacement": surface_displacement(nu, traction), **inner_fields(nu, traction)}
        for nu in POISSON_RATIOS
    ]
    np.savez_compressed(
        Path(__file__).with_name("tamaas_fields.npz"),
        made_with=f"tamaas {tamaas.__version__}, numpy {np.__version__}",
        youngs_modulus_pascal=YOUNGS_MODULUS_PASCAL,
        poisson_ratio=POISSON_RATIOS,
        pitch_m=PITCH_M,
        depth_m=np.array(KEPT) * DEPTH_STEP_M,
        traction=traction,
        **{name: np.stack([fields[name] for fields in of_each_body]) for name in of_each_body[0]},
    )
