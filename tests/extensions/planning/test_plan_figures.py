"""The figures of plans as they are saved: x to the right, y downwards."""

import math
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from resonator_daemon.base.plate import load_plate
from resonator_daemon.extensions.planning.figures import write_code_figure, write_density_figure


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Every figure as it is saved."""
    saved: list[Figure] = []
    save = Figure.savefig

    def remember(figure: Figure, *arguments: object) -> None:
        saved.append(figure)
        save(figure, *arguments)

    monkeypatch.setattr(Figure, "savefig", remember)
    return saved


def test_codes_stand_at_their_sites_and_y_points_downwards(tmp_path: Path, figures: list[Figure]) -> None:
    plate = load_plate("quartz16")
    codes = np.arange(101, 117)
    bands = plate.tones.f0_hz.min(axis=1), plate.tones.f0_hz.max(axis=1)
    write_code_figure(tmp_path / "codes.svg", plate, codes, bands, 1e-4, has_pilot=True)
    above = figures[0].axes[0]
    drawn = {text.get_text(): above.transData.transform(text.xy) for text in above.texts}
    right, down = (np.array([drawn[str(code)] for code in codes]) - drawn["101"]).T * [[1], [-1]]
    x_m, y_m = (plate.site_positions_m - plate.site_positions_m[0]).T
    assert np.ptp(right) > 50
    np.testing.assert_allclose(right / np.ptp(right), x_m / np.ptp(x_m), atol=1e-9)
    np.testing.assert_allclose(down / np.ptp(down), y_m / np.ptp(y_m), atol=1e-9)


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
