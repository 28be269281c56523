"""The figure of a plan of codes: every site where it is on the plate, x to the right and y downwards."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from resonator_daemon.base.plate import load_plate
from resonator_daemon.extensions.planning.figures import write_code_figure


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
