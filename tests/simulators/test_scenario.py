"""Scenario files: what they say, and what is said of those that are wrong."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from scenarios import steady

from resonator_daemon.base.plate import load_plate
from simulators import scenario_file
from simulators.scenario import Scenario, load_scenario
from simulators.scenario_file import Touch, shipped_scenarios
from simulators.scenario_schema import scenario_schema

QUARTZ = load_plate("quartz16")
COMB = load_plate("comb16")
SKIN = load_plate("skin32")
# What needs force sites or a skin; all others play on any plate.
ON_FORCE_SITES = {
    "creep", "hysteresis", "real", "slide", "slow-drift", "thermal-shock", "warm-finger", "whole-plate"
}  # fmt: skip
ON_A_SKIN = {"press-and-shear"}


def forces(scenario: Scenario, *times_s: float) -> list[list[float]]:
    return scenario.at(np.array(times_s)).force_newton[..., 2].tolist()


def held(**keys: Any) -> Touch:
    return steady(**{"hold_s": 1.0} | keys)


def sites_at(scenario: Scenario, time_s: float) -> list[int | None]:
    (contacts,) = scenario.contacts(scenario.at(np.array([time_s])))
    return [contact.site for contact in contacts]


def test_a_touch_rises_holds_and_falls_smoothly() -> None:
    touch = Touch(start_s=1.0, site=7, force_newton=2.0, rise_s=0.4, hold_s=1.0, fall_s=0.2)
    scenario = Scenario((touch,), None, QUARTZ)
    times_s = (0.0, 1.0, 1.1, 1.2, 1.4, 2.0, 2.4, 2.5, 2.6, 100.0)
    expected = [0.0, 0.0, 1 - np.sqrt(0.5), 1.0, 2.0, 2.0, 2.0, 1.0, 0.0, 0.0]
    assert [force for (force,) in forces(scenario, *times_s)] == pytest.approx(expected, abs=1e-12)


def test_shear_rises_to_its_peak_in_the_middle_of_the_hold_and_returns() -> None:
    content = {
        "start_s": 0.0, "position_mm": (0.0, 0.0), "force_newton": 2.0, "rise_s": 1.0, "hold_s": 4.0, "fall_s": 1.0
    }  # fmt: skip
    touch = Touch.model_validate(content | {"shear": {"peak_ratio": 0.9, "direction_deg": 120.0}})
    force = Scenario((touch,), None, SKIN).at(np.array([0.5, 1.0, 2.0, 3.0, 5.0, 5.5])).force_newton[:, 0]
    full = 0.9 * 0.5 * 2.0
    assert np.hypot(*force[:, :2].T) == pytest.approx([0.0, 0.0, full / 2, full, 0.0, 0.0], abs=1e-12)
    assert force[3, :2] == pytest.approx([-full / 2, full * np.sqrt(0.75)])


def test_each_repetition_of_a_touch_is_a_contact_of_its_own() -> None:
    touches = tuple(
        Touch(start_s=start_s, site=site, force_newton=1.0, rise_s=0.0, hold_s=0.5, fall_s=0.0)
        for start_s, site in ((0.25, 7), (1.75, 8))
    )
    pressing = Scenario(touches, 2.0, QUARTZ).at(np.array([0.5, 2.0, 2.5, 4.1, 4.5, 8.5]))
    pressed = pressing.force_newton[..., 2] > 0
    assert pressed.tolist() == [[1, 0], [0, 1], [1, 0], [0, 1], [1, 0], [1, 0]]  # the second reaches over the turn
    assert pressing.ids[pressed].tolist() == [1, 2, 3, 4, 5, 9]


def test_a_sliding_touch_goes_straight_to_its_end_while_it_is_held() -> None:
    touch = Touch(
        start_s=1.0, site=7, to_mm=(3.3, 3.5), force_newton=1.0, rise_s=0.5, hold_s=2.0, fall_s=0.5, kelvin=305.0
    )
    scenario = Scenario((touch, held(site=8, hold_s=9.0)), None, QUARTZ)
    pressing = scenario.at(np.array([0.5, 1.2, 1.5, 2.0, 3.5, 3.9, 9.0]))
    start, end = np.array([-0.5e-3, 2.0e-3]), np.array([3.3e-3, 3.5e-3])
    expected = [start + share * (end - start) for share in (0.0, 0.0, 0.0, 0.25, 1.0, 1.0, 1.0)]
    assert np.allclose(pressing.position_m[:, 0], expected, atol=1e-12)
    assert (pressing.position_m[:, 1] == scenario.positions_m[1]).all()
    assert np.allclose(scenario.positions_m[0], start)
    contacts = scenario.contacts(pressing)
    sites = [[contact.site for contact in contacts[moment]] for moment in (1, 3, 5)]
    assert sites == [[7, 8], [None, 8], [9, 8]]


def test_a_touch_of_the_whole_plate_is_a_contact_on_every_site() -> None:
    scenario = Scenario((held(site=7), held(whole_plate=True), held(site=8)), 2.0, QUARTZ)
    assert scenario.whole_plate.tolist() == [False, True, False]
    pressing = scenario.at(np.array([0.5, 2.5]))
    assert pressing.ids.tolist() == [[1, 2, 18], [19, 20, 36]]
    assert pressing.position_m[0, 1].tolist() == [0.0, 0.0]
    contacts = scenario.contacts(pressing)[1]
    assert [contact.id for contact in contacts] == list(range(19, 37))
    assert [contact.site for contact in contacts] == [7, *QUARTZ.site_ids.tolist(), 8]
    assert np.array_equal([contact.position_m for contact in contacts[1:-1]], QUARTZ.site_positions_m)
    assert {contact.force_newton for contact in contacts} == {(0.0, 0.0, 1.0)}


def test_the_environment_is_a_line_through_points_that_stays_after_the_last(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("environment_kelvin = [[10, 300], [20, 310.0], [40, 300]]")
    kelvin = load_scenario(str(path), QUARTZ).environment_kelvin(np.array([0.0, 10.0, 12.0, 20.0, 30.0, 100.0]))
    assert kelvin.tolist() == pytest.approx([300.0, 300.0, 302.0, 310.0, 305.0, 300.0])
    path.write_text("environment_kelvin = 301")
    assert load_scenario(str(path), QUARTZ).environment_kelvin(np.array([0.0, 9.0])).tolist() == [301.0, 301.0]
    assert Scenario((), None, QUARTZ).environment_kelvin(np.array([0.0, 9.0])).tolist() == [298.15, 298.15]


@pytest.mark.parametrize("name", shipped_scenarios())
def test_shipped_scenarios_play_on_the_plates_they_are_for_and_refuse_others_in_one_sentence(name: str) -> None:
    for plate, has_force_sites in ((QUARTZ, True), (COMB, True), (SKIN, False)):
        if name in (ON_A_SKIN if has_force_sites else ON_FORCE_SITES):
            with pytest.raises(
                ValueError, match=f"only for plates with .*, and {plate.name} has none; leave"
            ) as caught:
                load_scenario(name, plate)
            assert len(str(caught.value).splitlines()) == 1
        else:
            pressing = load_scenario(name, plate).at(np.arange(0.0, 700.0, 0.5))
            assert np.isfinite(pressing.force_newton).all()


SCHEMA = scenario_schema()
VALIDATOR = Draft202012Validator(SCHEMA)
SHIPPED = sorted(Path(scenario_file.__file__).with_name("scenarios").glob("*.toml"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_scenarios_keep_to_the_schema(path: Path) -> None:
    VALIDATOR.validate(tomllib.loads(path.read_text()))


def findings(tmp_path: Path, text: str) -> list[str]:
    """Return the keys of the messages about a file, in the order of the alphabet."""
    path = tmp_path / "mine.toml"
    path.write_text(text)
    try:
        load_scenario(str(path), QUARTZ)
    except ValueError as error:
        return sorted(line.removeprefix(f"{path}: ").split(": ")[0] for line in str(error).splitlines())
    return []


TOUCH = "[[touches]]\nstart_s = 0\nforce_newton = 1\n"
EVENT = "[[faults.events]]\nat_s = 1\n"


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        (f"{TOUCH}site = 1\nto_mm = [1, 2.5]\nkelvin = 300\n", []),
        ("environment_kelvin = 300\n", []),
        ("environment_kelvin = [[0, 300], [1.5, 301.0]]\n", []),
        ("[plate]\nideal = true\nsensitivity_scatter = 0.01\n", []),
        ("[faults]\nbit_error_rate = 1e-5\nsplit_bytes = 1\nmisbehave = ['limits', 'channels0']\n", []),
        (f"{EVENT}what = 'freeze'\nfor_s = 0.5\n", []),
        (f"{EVENT}what = 'rename'\nto = 'board.1'\n", []),
        (f"{EVENT}what = 'tick_step'\nticks = -5\n", []),
        ("[world]\nk = 1.02\nf0 = 2e-6\n", []),
        ("[world]\nkk = 1.02\n", ["world.kk"]),
        ("[world]\nk = '1.02'\n", ["world.k"]),
        ("[world]\noscillator = true\n", ["world.oscillator"]),
        ("period = 3\nperiod_s = 0\nseed = -1\n", ["period", "period_s", "seed"]),
        ("[plate]\nideal = 1\ncrep_fraction = 1\n", ["plate.crep_fraction", "plate.ideal"]),
        (
            "[[touches]]\nsite = 1\nforce_newton = -1\nhold = 2\n",
            ["touches[0].force_newton", "touches[0].hold", "touches[0].start_s"],
        ),
        (f"{TOUCH}site = 1\nto_mm = [1]\n", ["touches[0].to_mm[1]"]),
        (f"{TOUCH}site = 1\nshear = {{ direction_deg = 3 }}\n", ["touches[0].shear.peak_ratio"]),
        ('environment_kelvin = "warm"\ntouches = ["hard"]\n', ["environment_kelvin", "touches[0]"]),
        ("environment_kelvin = [300, 301]\n", ["environment_kelvin[0]", "environment_kelvin[1]"]),
        (
            "[faults]\nbit_eror_rate = 1\nburst_bits = 17\nclump_ms = -1\nmisbehave = ['cheats']\n",
            ["faults.bit_eror_rate", "faults.burst_bits", "faults.clump_ms", "faults.misbehave[0]"],
        ),
        (EVENT, ["faults.events[0].what"]),
        (f"{EVENT}what = 'rename'\n{EVENT}what = 'sleep'\n", ["faults.events[0]", "faults.events[1].what"]),
        (f"{EVENT}what = 'rename'\nto = 'a/b'\n", ["faults.events[0].to"]),
    ],
)
def test_schema_and_emulator_accept_the_same_and_every_mistake_is_named(
    tmp_path: Path, text: str, keys: list[str]
) -> None:
    assert VALIDATOR.is_valid(tomllib.loads(text)) == (keys == [])
    assert findings(tmp_path, text) == keys


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        ("environment_kelvin = []\n", ["environment_kelvin"]),
        ("[world]\nlayer = 10\n", ["world.layer"]),
        ("[world]\noscillator = -1\n", ["world.oscillator"]),
        ("environment_kelvin = [[5, 300], [5, 301]]\n", ["environment_kelvin"]),
        (f"{TOUCH}site = 17\n", ["touches[0].site"]),
        (f"{TOUCH}position_mm = [11, 0]\n", ["touches[0].position_mm"]),
        (f"{TOUCH}{TOUCH}site = 1\nposition_mm = [0, 0]\n", ["touches[0]", "touches[1]"]),
        (
            f"period_s = 2\n{TOUCH}site = 1\nhold_s = 3\n{TOUCH}site = 1\nwhole_plate = true\n",
            ["touches[0]", "touches[1]"],
        ),
        (f"{TOUCH}site = 1\nto_mm = [0, -11]\n", ["touches[0].to_mm"]),
        (f"{TOUCH}whole_plate = true\nto_mm = [1, 1]\n", ["touches[0].to_mm"]),
        (f"{TOUCH}site = 1\nto_mm = [1, 1]\nhold_s = 0\n", ["touches[0].hold_s"]),
    ],
)
def test_what_no_schema_can_state_is_named_too(tmp_path: Path, text: str, keys: list[str]) -> None:
    assert findings(tmp_path, text) == keys


def test_what_a_plate_cannot_do_is_named_key_by_key(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(
        "environment_kelvin = 300\n[plate]\nideal = true\nageing = 0.0\n"
        "[[touches]]\nstart_s = 0\nforce_newton = 1\nsite = 1\nto_mm = [0, 0]\nkelvin = 300\n"
    )
    with pytest.raises(ValueError, match="with force sites, and skin32 has none") as caught:
        load_scenario(str(path), SKIN)
    keys = str(caught.value).removeprefix(f"{path}: ").split(": only")[0]
    assert keys.split(", ") == ["environment_kelvin", "plate.ageing", "touches.kelvin", "touches.to_mm"]
    assert sites_at(load_scenario(str(path), QUARTZ), 0.1) == [1]  # where its slide begins
