"""The figure of power densities: dark is strong, x to the right, y downwards, profiles below."""

import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imread

from resonator_daemon.extensions.planning.figures import write_density_figure

OMEGA = np.linspace(-2e3, 2e3, 41)


def blob(wx: float, wy: float) -> np.ndarray:
    """Power that is strong around one frequency, in rad/mm."""
    return np.exp(-20.0 * ((OMEGA * 1e-3 - wx) ** 2 + (OMEGA[:, None] * 1e-3 - wy) ** 2))


def test_dark_is_strong_and_every_panel_has_its_own_scale(tmp_path: Path, figures: list[Figure]) -> None:
    path = tmp_path / "two.png"
    write_density_figure(path, ["right", "down"], np.stack([blob(1.0, 0.0), 7.0 * blob(0.0, 1.0)]), OMEGA, "both")
    picture = imread(path)[..., :3].mean(axis=-1)
    figure = figures[0]
    height = picture.shape[0]
    for axes, dark, light in zip(figure.axes[:2], ((1.0, 0.0), (0.0, 1.0)), ((-1.0, 0.0), (0.0, -1.0)), strict=True):
        (dark_x, dark_y), (light_x, light_y) = axes.transData.transform([dark, light]).round().astype(int)
        assert (np.sign(dark_x - light_x), np.sign(light_y - dark_y)) == dark
        assert picture[height - dark_y, dark_x] < 0.05
        assert picture[height - light_y, light_x] > 0.95


def test_profiles_run_through_the_middle(tmp_path: Path, figures: list[Figure]) -> None:
    power = blob(0.0, 0.0) * (1.0 + OMEGA * 1e-3 / 4.0)
    power[20, 20] = np.nan  # has no value, and is no maximum
    write_density_figure(tmp_path / "one.svg", ["one"], power[None], OMEGA, "one")
    lines = figures[0].axes[1].lines
    assert [line.get_label() for line in lines] == ["0°", "45°", "90°"]
    for line, angle in zip(lines, (0.0, math.pi / 4, math.pi / 2), strict=True):
        w, values = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
        expected = np.exp(-20.0 * w**2) * (1.0 + w * math.cos(angle) / 4.0) / np.nanmax(power)
        expected[20] = np.nan
        np.testing.assert_allclose(values, expected, atol=1e-12)
