"""Plates: what ships, what a file may say, and what a wrong one is told."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from config_files import findings
from plates import site
from pydantic import ValidationError

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.base.plate import Plate, load_plate

PILOT = "pilot_hz = 10010000.0\n"
HERE = Path(__file__).parent
FORCE_PLATE, GRID_PLATE = ((HERE / f"{kind}_plate.toml").read_text() for kind in ("force", "grid"))
SKIN_SITE = site(1, 1, 0.5, eps_yz=(3e6, 3e-6), p_n=(1e6, -1e-11), eps_xz=(2e6, 2e-6))


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "plate.toml"
    path.write_text(text)
    return path


def refusals(tmp_path: Path, text: str) -> list[str]:
    return findings(load_plate, written(tmp_path, text))


def test_a_file_is_given_in_si_units(tmp_path: Path) -> None:
    plate = load_plate(written(tmp_path, FORCE_PLATE))
    assert (plate.name, plate.format, plate.force_max_newton, plate.signals) == ("two", 1, 10.0, ("force",))
    assert (plate.counter.reference_hz, plate.counter.frame_rate_hz, plate.counter.pilot_hz) == (1e9, 1000.0, 10.01e6)
    assert (plate.skin, plate.grid, plate.load_sharing_exponent) == (None, None, None)
    corners_m = np.array([[0.0, 0.0], [0.02, 0.0], [0.02, 0.01], [0.0, 0.01]])
    np.testing.assert_allclose(plate.outline_m, corners_m)
    np.testing.assert_allclose(plate.transducers_m, corners_m)
    np.testing.assert_array_equal(plate.site_ids, [7, 3])
    np.testing.assert_allclose(plate.site_positions_m, [[0.006, 0.004], [0.0125, 0.004]])


def test_explicit_skin_sites_index_the_published_signals(tmp_path: Path) -> None:
    head = GRID_PLATE[: GRID_PLATE.index("[grid]")]
    plate = load_plate(written(tmp_path, head + SKIN_SITE))
    assert plate.signals == ("p_n", "eps_xz", "eps_yz")
    np.testing.assert_array_equal(plate.tones.site_index, [0, 0, 0])
    np.testing.assert_array_equal(plate.tones.signal_index, [2, 0, 1])
    np.testing.assert_array_equal(plate.tones.f0_hz[:, 0], [3e6, 1e6, 2e6])


def test_a_grid_is_numbered_by_its_order(tmp_path: Path) -> None:
    plate = load_plate(written(tmp_path, GRID_PLATE))
    assert plate.skin
    assert plate.skin.depth_m == pytest.approx(1.5e-3)
    assert plate.skin.gain_std == 0
    assert plate.grid
    assert plate.grid.pitch_m == pytest.approx(4e-4)
    np.testing.assert_array_equal(plate.site_ids, [1, 2, 3, 4, 5, 6])
    rows_mm: list[list[float]] = [[-0.4, -0.2], [0, -0.2], [0.4, -0.2], [-0.4, 0.2], [0, 0.2], [0.4, 0.2]]
    np.testing.assert_allclose(plate.site_positions_m, np.array(rows_mm) * 1e-3, atol=1e-12)
    # With order = [1, 3, 6], x runs fastest, then y, then the file's signals: eps_xz, p_n, eps_yz.
    np.testing.assert_array_equal(plate.tones.site_index, [0, 1, 2, 3, 4, 5] * 3)
    assert plate.signals == ("p_n", "eps_xz", "eps_yz")
    np.testing.assert_array_equal(plate.tones.signal_index, [1] * 6 + [0] * 6 + [2] * 6)
    np.testing.assert_array_equal(plate.tones.f0_hz, np.repeat(100e6 + 1e3 * np.arange(18), 4).reshape(18, 4))
    np.testing.assert_array_equal(plate.tones.sensitivity[:, 2], [3e-6] * 6 + [-2e-11] * 6 + [4e-6] * 6)


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ("-6.3e-6", "0.0", "17: sites[0].tones[0].sensitivity[0]"),
        ("9996000.0", "-9996000.0", "16: sites[0].tones[0].f0_hz[0]"),
        ('"force"', '"forse"', "15: sites[0].tones[0].signal"),
        ("id = 3", "id = 7", "19: sites[1].id"),
        ("[12.5, 4.0]", "[12.5, 10.5]", "20: sites[1].position_mm"),
        ("position_mm = [12.5", "position_m = [12.5", "18: sites[1].position_mm: missing"),
        ("single-tone", "single", "7: counter.kind"),
        ("format = 1", "format = 2", "1: format"),
        ("[20, 10], [0, 10]]\ntrans", "[10, 0]]\ntrans", "3: outline_mm"),
        ("[0, 10]]\nforce", "[0, 11]]\nforce", "4: transducers_mm[3]"),
        ("[0, 10]]\nforce", "[0, 0]]\nforce", "4: transducers_mm[3]"),
        ("force_max_newton = 10", "force_max_newton = 1e-320", "5: force_max_newton"),
        ("pilot_hz = 10010000.0", "pilot_hz = 9992001.0", "10: counter.pilot_hz"),
        ("frame_rate_hz = 1000", "frame_rate_hz = 1000\ndepth_mm = 1", "10: counter.depth_mm: unknown key"),
        ("[1, 3, 6]", "[1, 3, 5]", "20: grid.order"),
        ('"eps_yz"]', '"p_n"]', "17: grid.signals"),
        ('"eps_yz"]', '"force"]', "17: grid.signals[2]"),
        ("poisson_ratio = 0.5", "poisson_ratio = 0.6", "12: skin.poisson_ratio"),
        ("frame_rate_hz = 100\n", "frame_rate_hz = 100\npilot_hz = 1e6\n", "10: counter.pilot_hz"),
        ('"channelised"', '"single-tone"\npilot_hz = 1e6', "7: counter.kind"),
    ],
)
def test_one_mistake_in_a_plate(tmp_path: Path, before: str, after: str, expected: str) -> None:
    plate = FORCE_PLATE if before in FORCE_PLATE else GRID_PLATE
    messages = [m for m in refusals(tmp_path, plate.replace(before, after, 1)) if "did you mean pos" not in m]
    assert any(message.startswith(expected) for message in messages), messages
    assert len(messages) == 1 or len([message for message in messages if "missing" not in message]) == 1, messages


def test_tones_that_do_not_go_together(tmp_path: Path) -> None:
    skin, grid = GRID_PLATE.index("[skin]"), GRID_PLATE.index("[grid]")
    head, tone = GRID_PLATE[:grid], FORCE_PLATE[FORCE_PLATE.rindex("[[sites.tones]]") :]
    for text, expected in (
        (GRID_PLATE[:skin] + GRID_PLATE[grid:], "skin: a plate with skin signals needs a [skin]"),
        (GRID_PLATE + SKIN_SITE, "either [[sites]] or a [grid]"),
        (head, "either [[sites]] or a [grid]"),
        ("sites = []\n" + head, "1: sites: got []"),
        (FORCE_PLATE + SKIN_SITE, "sites: got ['eps_xz', 'eps_yz', 'force', 'p_n']"),
        (FORCE_PLATE + tone, "18: sites[1].tones: got ['force', 'force']"),
        (head + SKIN_SITE[: SKIN_SITE.rindex("[[sites.tones]]")], "sites[0].tones: got ['eps_yz', 'p_n']"),
    ):
        assert any(expected in message for message in refusals(tmp_path, text)), expected


def test_a_counter_needs_no_more_than_its_kind() -> None:
    values = f"reference_hz = 1000000000.0\nframe_rate_hz = 1000\n{PILOT}"
    plate = Plate.model_validate(tomllib.loads(FORCE_PLATE.replace(values, "")))
    assert (plate.counter.reference_hz, plate.counter.frame_rate_hz) == (1e9, 1000)
    assert plate.pilot_hz == pytest.approx(9996003.0 * 1.001)
    assert Plate.model_validate(tomllib.loads(FORCE_PLATE)).pilot_hz == 10.01e6


def one_sign(text: str) -> str:
    return text.replace(", 6.0e-6]", ", -6.0e-6]").replace(", 5.0e-6]", ", -5.0e-6]")


def test_corners_of_one_sign_where_a_channelised_counter_combines_them(tmp_path: Path) -> None:
    """Where one tone is captured at a time, each corner is a reading of its own, with K of either sign."""
    text = FORCE_PLATE.replace('"single-tone"', '"channelised"').replace(PILOT, "")
    tone = text[text.rindex("[[sites.tones]]") :].replace('"force"', '"temperature"')
    load_plate(written(tmp_path, one_sign(text)))
    for wrong, places in ((text, ("16: sites[0]", "23: sites[1]")), (one_sign(text) + tone, ("27: sites[1]",))):
        for message, place in zip(refusals(tmp_path, wrong), places, strict=True):
            assert message.startswith(place)
            assert "sensitivity" in message


def test_a_channelised_counter_may_receive_forces_and_the_temperature_of_their_sites(tmp_path: Path) -> None:
    text = one_sign(FORCE_PLATE.replace('"single-tone"', '"channelised"').replace(PILOT, ""))
    tone = text[text.rindex("[[sites.tones]]") :].replace('"force"', '"temperature"').replace("99", "98")
    plate = load_plate(written(tmp_path, text + tone + "temperature_coefficients = [-5e-8, -5e-10, 1e-10]\n"))
    assert plate.signals == ("force", "temperature")
    np.testing.assert_array_equal(plate.tones.signal_index, [0, 0, 1])
    np.testing.assert_array_equal(plate.tones.site_index, [0, 1, 1])
    np.testing.assert_array_equal(plate.tones.temperature_coefficients[2], [-5e-8, -5e-10, 1e-10])
    assert np.isnan(plate.tones.temperature_coefficients[:2]).all()


def test_a_spread_of_touches_needs_sites_enough_and_tones_that_are_all_received(tmp_path: Path) -> None:
    text = FORCE_PLATE.replace("[counter]", "spread_width_mm = 2.5\n[counter]")
    few, captured = refusals(tmp_path, text)
    assert "spread_width_mm: got 2.5; needs at least 4 sites, there are 2" in few
    assert "spread_width_mm: got 2.5; belongs to a channelised counter of force sites" in captured
    assert load_plate("comb16").spread_width_m == pytest.approx(2.5e-3)


def test_what_a_calibration_states(tmp_path: Path) -> None:
    text = FORCE_PLATE + (
        "[thermal]\nrange_kelvin = [280, 320]\ncontact_std_kelvin = 4\n"
        "[response]\nhysteresis_newton = 0.1\ncreep_fraction = 0.005\ncreep_time_s = 20\n"
        '[calibration]\nid = "c1"\ndate = 2026-11-01\nmodel_error = 0.01\n'
        "validity = { force_newton = [0.5, 5.0], kelvin = [293, 303] }\n"
        "coupling = [{ pressed = 7, measured = 3, ratio = 0.02 }]\n"
    )
    plate = load_plate(written(tmp_path, text))
    assert plate.response is not None
    assert plate.calibration.validity is not None
    assert (plate.response.hysteresis_newton, plate.thermal.contact_std_kelvin) == (0.1, 4.0)
    assert plate.calibration.validity.force_newton == (0.5, 5.0)
    assert (plate.calibration.id, str(plate.calibration.date), plate.calibration.expiry) == ("c1", "2026-11-01", None)
    (message,) = refusals(tmp_path, text.replace("[0.5, 5.0]", "[5.0, 0.5]"))
    assert "calibration.validity.force_newton: got" in message


def test_a_concave_outline_has_its_notch_outside(tmp_path: Path) -> None:
    outline = "[[0, 0], [20, 0], [20, 10], [14, 10], [14, 3], [10, 3], [10, 10], [0, 10]]"
    text = FORCE_PLATE.replace("[[0, 0], [20, 0], [20, 10], [0, 10]]", outline, 1)
    assert refusals(tmp_path, text) == ["20: sites[1].position_mm: got [12.5, 4.0]; lies outside outline_mm"]
    load_plate(written(tmp_path, text.replace("[12.5, 4.0]", "[12.5, 3.0]")))  # on the border
    load_plate(written(tmp_path, text.replace("[12.5, 4.0]", "[14.5, 9.0]")))


def explicit_sites(count: int) -> dict[str, Any]:
    content: dict[str, Any] = tomllib.loads(GRID_PLATE[: GRID_PLATE.index("[grid]")] + SKIN_SITE)
    tones = content["sites"][0]["tones"]
    places = [(-2 + 4 * (index % 200) / 200, -1 + 2 * (index // 200) / 80) for index in range(count)]
    content["sites"] = [{"id": i, "position_mm": list(place), "tones": tones} for i, place in enumerate(places, 1)]
    return content


def test_as_many_explicit_tones_as_a_frame_holds() -> None:
    """4 channels x 63 parts x 744 tones: 255 parts at most, so 46 872 tones; one site more is too many."""
    assert len(Plate.model_validate(explicit_sites(15_624)).tones.f0_hz) == 46_872
    with pytest.raises(ValidationError, match="46872"):
        Plate.model_validate(explicit_sites(15_625))


def test_a_sensor_that_no_package_has_is_refused_with_those_that_are_there(tmp_path: Path) -> None:
    (tmp_path / "two.toml").write_text(FORCE_PLATE.replace(PILOT, PILOT + 'sensor = "unheard-of"\n'))
    with pytest.raises(ConfigurationError, match="multitone, single-tone, skin"):
        load_plate(tmp_path / "two.toml")
    (tmp_path / "two.toml").write_text(FORCE_PLATE.replace(PILOT, PILOT + 'sensor = "single-tone"\n'))
    assert load_plate(tmp_path / "two.toml").default_sensor == "single-tone"
