"""The plan of a skin's sensors: what it says, its object and its pictures, and `resonatord plan sensors`."""

import io
import json
import math
from functools import cache

import numpy as np
import pytest
from command_line import exit_code
from rich.console import Console

from resonator_daemon.commands import main
from resonator_daemon.estimate.elastic.half_space import HalfSpace
from resonator_daemon.estimate.elastic.sensor_resolution import SensorArray
from resonator_daemon.estimate.elastic.sensor_sets import SensorSet
from resonator_daemon.extensions.planning.sensor_plan import FEATURES_M, SensorPlan


@cache
def plan(*components: str, nu: float = 0.5, depth_m: float = 1e-3, pitch_m: float = 0.4e-3, snr_db: float = 30.0):
    return SensorPlan(SensorArray(SensorSet(HalfSpace(2e5, nu), components, depth_m), pitch_m, snr_db))


def rendered(shown: SensorPlan, width: int = 80, **options: object) -> list[str]:
    stream = io.StringIO()
    Console(file=stream, width=width, highlight=False, **options).print(shown)
    return stream.getvalue().splitlines()


def panel(lines: list[str], title_line: int, column: int) -> np.ndarray:
    """Density of a picture's characters, rows from the top."""
    rows = [line.ljust(80)[24 * column : 24 * column + 22] for line in lines[title_line + 1 : title_line + 12]]
    return np.array([[" .:-=+*#%@".index(letter) for letter in row] for row in rows])


@pytest.mark.parametrize(
    ("components", "array", "words"),
    [
        ("xx,yy,zz", {}, ["incompressible", "give rank 2; add p_n", "only along 0° and 90°"]),
        ("xy,xx,yy", {"nu": 0.3}, ["compatibility"]),
        ("p_n,zz,xy", {}, ["resolves normal load down to", "only along 45° and 135°, where the rank drops"]),
        ("p_n", {}, ["resolves the normal load of a touch without friction", "one signal gives rank 1"]),
        (
            "p_n,xz,yz",
            {"snr_db": -20.0},
            ["resolves no load in all directions", "hide normal and shear of every width"],
        ),
        ("xz,yz", {"pitch_m": 2e-3, "snr_db": 10.0}, ["touch without friction from ", " mm down to "]),
    ],
)
def test_what_a_skin_cannot_feel_is_said_with_its_reason(
    components: str, array: dict[str, float], words: list[str]
) -> None:
    sentence = plan(*components.split(","), **array).sentence()
    assert [word for word in words if word not in sentence] == []
    assert "nan" not in sentence


def test_the_object_is_strict_json_in_si_units() -> None:
    for shown in (plan("p_n", "xz", "yz"), plan("xx", snr_db=-40.0)):
        found = json.loads(json.dumps(shown.as_json(), allow_nan=False))
        assert [row["feature_m"] for row in found["features"]] == list(FEATURES_M)
    found = plan("p_n", "xz", "yz").as_json()
    assert found["signals"][0]["bandwidth_rad_per_m"] == pytest.approx(1e3 / math.sqrt(2.0))
    assert found["signals"][1]["strongest_per_pascal"] == pytest.approx(1.5 / 2e5)  # shear over 2 mu
    assert found["condition_at_inverse_depth"] == pytest.approx([2.618034] * 2)
    assert found["features"][1]["deepest_m"]["shear"] == pytest.approx(1.45e-3, rel=0.01)
    assert found["features"][0]["deepest_m"]["shear"] is None
    assert plan("p_n").as_json()["condition_at_inverse_depth"] == [None, None]


def test_tables_and_pictures_fit_the_width() -> None:
    lines = rendered(plan("p_n", "xz", "yz"))
    assert max(map(len, lines)) <= 80
    assert any(line.split() == ["2", "3.47", "3.35", "6.27", "1.35", "1.25", "2"] for line in lines)
    assert any(line.split() == ["xz", "0.866", "0.236", "7500", "-"] for line in lines)
    first = next(n for n, line in enumerate(lines) if line.split() == ["p_n", "xz", "yz"])
    assert lines[first + 12].split() == ["set"]
    p_n, xz, yz = (panel(lines, first, column) for column in range(3))
    together = panel(lines, first + 12, 0)
    for symmetric in (p_n, together):
        np.testing.assert_array_equal(symmetric, symmetric[::-1, ::-1])
        assert symmetric[5, 10] >= 8  # dense in the middle, where the signal is strong
        assert symmetric[0, 0] == 0
    assert together.sum() > p_n.sum()  # shear strains reach further out
    assert (xz[5, :6] > 0).all()  # short waves along x, not along y
    assert (xz[0] == 0).all()
    assert (yz[5, :2] == 0).all()
    assert (yz[0] > 0).any()


def test_json_is_one_object_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("--set", "xx,yy,zz", "--depth-mm", "2", "--pitch-mm", "1", "--poisson-ratio", "0.3")
    assert main(["plan", "sensors", "--json", *asked]) == 0
    printed, reported = capsys.readouterr()
    assert reported == ""
    found = json.loads(printed)
    assert found["components"] == ["xx", "yy", "zz"]
    assert (found["depth_m"], found["pitch_m"], found["poisson_ratio"]) == (0.002, 0.001, 0.3)
    assert found["youngs_modulus_pascal"] == 2e5
    assert found["rank"] == 3


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--set", "p_n,xzz"), "'xzz' is unknown; did you mean zz? must be one of: p_n, xx"),
        (("--set", "p_n,p_n"), "'p_n' is named 2 times, must be once"),
        (("--pitch-mm", "30"), "at most four depths, 0.004: a sparser array"),
        (("--depth-mm", "0"), "depth_m is 0, must be from 1e-09 to 1000"),
        (("--picture", "set.gif"), "'set.gif' must end in .svg, .png or .pdf"),
    ],
)
def test_bad_values_are_usage_errors_of_one_sentence(
    arguments: tuple[str, ...], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code("plan", "sensors", *arguments) == 2
    assert complaint in capsys.readouterr().err.splitlines()[-1]
