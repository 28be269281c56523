"""`resonatord plan codes` as a user meets it, and what both planners refuse."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import exit_code
from plates import plate_head, site

from resonator_daemon.base.plate import load_plate
from resonator_daemon.commands import main
from resonator_daemon.measure.sensors import plate_sites

GRID = ("--grid", "4x4", "--pitch-mm", "5")
ON_GRID = ("codes", *GRID)


def plan(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, Any], list[str]]:
    """Return exit code, the object on stdout, and the lines on stderr."""
    code = main(["plan", "codes", "--json", "--touches", "500", *arguments])
    printed = capsys.readouterr()
    return code, json.loads(printed.out) if printed.out else {}, printed.err.splitlines()


def test_a_planned_plate_passes_check_and_comes_back_as_it_was_shown(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path, config = tmp_path / "new-plate.toml", tmp_path / "config.toml"
    code, found, reported = plan(capsys, *GRID, "--output", str(path))
    assert (code, reported) == (0, [])
    config.write_text('plate = "new-plate.toml"\nlink = "tcp://127.0.0.1:1"\n')
    assert main(["check", str(config)]) == 0, capsys.readouterr().err
    plate = load_plate(str(path))
    assert plate.name == "new-plate"
    assert plate.tones.f0_hz.tolist() == [site["f0_hz"] for site in found["sites"]]
    assert plate.tones.sensitivity.tolist() == [site["sensitivity"] for site in found["sites"]]
    assert plate.site_positions_m.tolist() == [site["position_m"] for site in found["sites"]]
    np.testing.assert_allclose(plate.site_positions_m[:5], 1e-3 * np.array([[-7.5, -7.5], [-2.5, -7.5], [2.5, -7.5],
        [7.5, -7.5], [-7.5, -2.5]]))  # fmt: skip
    assert plate.outline_m.tolist() == [[-0.01, -0.01], [0.01, -0.01], [0.01, 0.01], [-0.01, 0.01]]
    assert not plate.counter.codes_may_overlap
    assert plate.counter.reference_hz == 1e9
    assert plate.calibration.sensitivity_std == pytest.approx(np.std(np.linspace(-0.3, 0.3, 100_001)), rel=1e-4)
    assert found["ok"] is True
    assert found["band"]["trapped_ppm"] == pytest.approx(15_000)
    assert found["guard_band_ppm"]["step"] == pytest.approx(
        81.9 + 20 * 6 * 5e-2 + 2 + 2 * 25 + 2 * 20 + 2 * 13.8**0.5 * 81.9 * 0.015, abs=0.01
    )
    assert found["step_ppm"] == pytest.approx(np.ceil(found["guard_band_ppm"]["step"]))
    assert found["trials"]["plates_overlapping"] == 0
    assert found["trials"]["one_touch"]["wrong"] == 0


def test_tables_list_the_ladder_from_the_highest_tone_down(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "codes", "--touches", "500", *GRID]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:17]]
    assert [int(row[0]) for row in rows] == list(range(1, 17))
    tones_hz = [float(row[4]) for row in rows]
    assert tones_hz == sorted(tones_hz, reverse=True)
    # f0 / (1 - K F) at 10 N.
    assert float(rows[0][6]) == pytest.approx(tones_hz[0] / (1 - 10e-6 * float(rows[0][5])), abs=1.0)


@pytest.mark.parametrize("extra", [(), ("--step-ppm", "400"), ("--seed", "5")])
def test_the_numbers_of_quartz16_give_a_ladder_without_collisions(
    extra: tuple[str, ...], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "again.toml"
    code, found, complaints = plan(capsys, "--plate", "quartz16", "--output", str(path), *extra)
    assert (code, complaints) == (0, [])
    plate, shipped = load_plate(str(path)), load_plate("quartz16")
    assert plate_sites.overlaps(plate) == ()
    np.testing.assert_array_equal(plate.site_positions_m, shipped.site_positions_m)
    np.testing.assert_array_equal(plate.tones.sensitivity, shipped.tones.sensitivity)
    assert plate.load_sharing_exponent == shipped.load_sharing_exponent
    assert found["neighbours_too_near"] == []
    trials = found["trials"]
    assert (trials["plates_overlapping"], trials["one_touch"]["wrong"], trials["two_touches"]["wrong"]) == (0, 0, 0)
    if "400" in extra:
        assert 9_936_000.0 in plate.tones.f0_hz
        assert found["band"]["used_ppm"] == pytest.approx(1000 + 15 * 400 + 50, rel=0.02)


def test_a_plate_gives_what_no_option_gives(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    coefficients = "temperature_coefficients = [-5e-8, -5e-10, 1e-10]\n"
    head = plate_head("known", (-9, -9), (9, 9), 5, reference_hz=250e6, frame_rate_hz=500, pilot_hz=5.005e6)
    thermal = "[thermal]\nrange_kelvin = [295, 300]\ncoefficient_std = 1e-8\n"
    sites = (site(number, x_mm, 0, force=(hz, 4e-6)) for number, x_mm, hz in ((4, -5, 4.99e6), (9, 5, 4.98e6)))
    path, new = tmp_path / "known.toml", tmp_path / "new.toml"
    path.write_text(head + thermal + "".join(one + coefficients for one in sites))
    code, found, _ = plan(capsys, "--plate", str(path), "--output", str(new))
    assert code == 0
    assert found["guard_band_ppm"]["force"] == pytest.approx(4 * 5)
    assert found["guard_band_ppm"]["temperature"] == pytest.approx(6 * 0.01 * 5)
    # 12 s^2 / (N T^2) with s of 4 ns / sqrt(12) and 0.3 ns, N = 1e5, T = 10 ms, on four channels.
    counter_newton = ((4e-9**2 / 12 + 0.3e-9**2) * 12 / 1e5) ** 0.5 / 10e-3 / 4e-6 / 2
    assert found["force_noise"]["counter_newton"] == pytest.approx(counter_newton)
    plate = load_plate(str(new))
    assert (plate.counter.reference_hz, plate.counter.frame_rate_hz, plate.force_max_newton) == (250e6, 500, 5)
    assert plate.thermal.range_kelvin == (295.65, 300.65)
    assert plate.site_ids.tolist() == [4, 9]
    assert plate.calibration.sensitivity_std == 0
    # The ladder begins one step below what the pilot is 0.1 % above.
    assert plate.tones.f0_hz.max() == pytest.approx(5e6 * (1 - 1e-6 * found["step_ppm"]), abs=0.1)
    code, found, _ = plan(capsys, "--plate", str(path), "--counter-tick-ns", "1", "--temperature-span-kelvin", "10")
    assert found["guard_band_ppm"]["temperature"] == pytest.approx(6 * 0.01 * 10)
    assert found["force_noise"]["counter_newton"] < 0.4 * counter_newton


def test_a_step_below_the_guard_band_is_refused_with_the_pair_and_written_when_insisted(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "narrow.toml"
    arguments = (*GRID, "--step-ppm", "60", "--pull-ppm", "0", "--output", str(path))
    code, found, complaints = plan(capsys, *arguments)
    assert (code, found["ok"]) == (1, False)
    assert not path.exists()
    (complaint,) = complaints
    one, other = (site["site"] for site in found["sites"] if site["code"] in (1, 2))
    for word in (f"sites {one} and {other} ", "60 ppm", "139 ppm", "--step-ppm", "--accept"):
        assert word in complaint
    code, found, complaints = plan(capsys, *arguments, "--accept-overlap")
    assert (code, complaints) == (0, [])
    plate = load_plate(str(path))
    assert plate.counter.codes_may_overlap
    assert plate_sites.overlaps(plate)
    assert plate_sites.findings(plate) == ()
    assert found["trials"]["plates_overlapping"] == found["trials"]["plates"]
    assert found["trials"]["one_touch"]["undecided"] > 10


@pytest.mark.parametrize("first", ["", "x_mm, y_mm\n\n"])
def test_positions_are_read_from_lines(first: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "sites.csv"
    path.write_text(f"{first}-6.1,4.2\n3, -5\n")
    _, found, _ = plan(capsys, "--sites", str(path))
    np.testing.assert_allclose([site["position_m"] for site in found["sites"]], [[-6.1e-3, 4.2e-3], [3e-3, -5e-3]])


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"1,2\n1,2,3\n", "sites.csv:2: got '1,2,3'"), (b"x,y\n", "sites.csv:1: got 'x,y'"),
        (b"1,2\n3,4\n1.0,2\n", "sites.csv:3: got '1.0,2'"), (b"nan,1\n", "sites.csv:1: got 'nan,1'"),
        (b"1e5,1\n", "within +-10000"), (b"\n", "no positions"), (b"\xff\xfe1,2", "cannot be read"),
        (None, "cannot be read: No such file"),
    ],
)  # fmt: skip
def test_the_line_that_is_no_position_is_named(
    content: bytes | None, complaint: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "sites.csv"
    if content is not None:
        path.write_bytes(content)
    assert exit_code("plan", "codes", "--sites", str(path)) == 2
    assert complaint in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("codes",), "give --sites or --plate or --grid"),
        ((*ON_GRID, "--force-max-newton", "1e4", "--sensitivity-ppm-per-newton", "100"), "shift is 1.3e+06 ppm"),
        ((*ON_GRID, "--band-ppm", "1000"), "--band-ppm 1000: pilot and largest force alone need 1082"),
        ((*ON_GRID, "--sensitivity-ppm-per-newton", "0"), "--sensitivity-ppm-per-newton 0"),
        ((*ON_GRID, "--stamps-per-s", "1e9"), "--stamps-per-s 1e+09: 1e+06 in a frame"),
        (("codes", "--grid", "20x20", "--pitch-mm", "5"), "400 sites; at most 256"),
        (("codes", "--plate", "skin32"), "'skin32' has a channelised counter of p_n, eps_xz, eps_yz"),
        (("sensors", "--set", "p_n,xzz"), "'xzz' is unknown; must be one of: p_n, xx"),
        (("sensors", "--set", "p_n,p_n"), "'p_n' is named 2 times, must be once"),
        (("sensors", "--pitch-mm", "30"), "at most four depths, 0.004: a sparser array"),
        (("sensors", "--depth-mm", "0"), "depth_m is 0, must be from 1e-09 to 1000"),
        (("sensors", "--snr-db", "101"), "snr_db is 101, must be from -40 to 100"),
    ],
)
def test_bad_values_are_usage_errors_of_one_sentence(
    arguments: tuple[str, ...], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code("plan", *arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert complaint in printed.err.splitlines()[-1]
