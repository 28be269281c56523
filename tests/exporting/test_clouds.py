"""Where the points of a cloud lie."""

import numpy as np
from export_bench import played

from resonator_daemon.exporting.clouds import Clouds
from resonator_daemon.publishing.payloads import Decoded, Grid

NAMES = [f"{what}_{axis}_{unit}" for what, unit in (("traction", "pascal"), ("displacement", "m")) for axis in "xyz"]


def test_a_map_has_its_pixels_at_their_places() -> None:
    traction = np.arange(60, dtype=np.float32).reshape(3, 4, 5)
    message = Decoded.model_construct(
        traction_pascal=traction,
        traction_std_pascal=None,
        displacement_m=2 * traction,
        grid=Grid(origin_m=(-0.01, 0.02), pitch_m=0.5e-3),
    )
    plate = played("skin").config.plate
    points = Clouds(plate.site_ids, plate.site_positions_m).points(message)
    assert points is not None
    assert points.dtype.names == ("x", "y", "z", *NAMES)
    row, column = 2, 3
    point = points.reshape(4, 5)[row, column]
    np.testing.assert_allclose([point["x"], point["y"], point["z"]], [-0.0085, 0.021, 0.0], rtol=1e-6)
    assert point["traction_y_pascal"] == traction[1, row, column]
    assert point["displacement_z_m"] == 2 * traction[2, row, column]
