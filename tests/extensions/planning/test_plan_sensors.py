"""`resonatord plan sensors` as a user meets it."""

import json

import pytest
from command_line import exit_code

from resonator_daemon.commands import main


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
