"""Scenario files: what they say, and what is said of those that are wrong."""

from pathlib import Path

import numpy as np
import pytest

from resonator_daemon.plate import load_plate
from simulators.scenario import Scenario, Touch, default_scenario, load_scenario, shipped_scenarios

QUARTZ = load_plate("quartz16")
SKIN = load_plate("skin32")


def forces(scenario: Scenario, *times_s: float) -> list[list[float]]:
    return scenario.at(np.array(times_s)).force_newton[..., 2].tolist()


def test_a_touch_rises_holds_and_falls_smoothly() -> None:
    touch = Touch(start_s=1.0, site=7, force_newton=2.0, rise_s=0.4, hold_s=1.0, fall_s=0.2)
    scenario = Scenario((touch,), None, QUARTZ)
    times_s = (0.0, 1.0, 1.1, 1.2, 1.4, 2.0, 2.4, 2.5, 2.6, 100.0)
    expected = [0.0, 0.0, 1 - np.sqrt(0.5), 1.0, 2.0, 2.0, 2.0, 1.0, 0.0, 0.0]
    assert [force for (force,) in forces(scenario, *times_s)] == pytest.approx(expected, abs=1e-12)


def test_shear_rises_to_its_peak_in_the_middle_of_the_hold_and_returns() -> None:
    content = {
        "start_s": 0.0,
        "position_mm": (0.0, 0.0),
        "force_newton": 2.0,
        "rise_s": 1.0,
        "hold_s": 4.0,
        "fall_s": 1.0,
    }
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


@pytest.mark.parametrize("name", shipped_scenarios())
def test_shipped_scenarios_fit_the_plates_they_are_for(name: str) -> None:
    for plate in (QUARTZ, SKIN):
        assert load_scenario(name, plate).at(np.array([0.0])).ids.shape[0] == 1


def test_the_shipped_ones_are_those_that_are_named() -> None:
    assert set(shipped_scenarios()) == {"touches", "press-and-shear", "still", "held", "between", "too-hard"}
    assert default_scenario(QUARTZ) == "touches"
    assert default_scenario(SKIN) == "press-and-shear"


def test_touches_visits_every_site_once_with_all_forces() -> None:
    scenario = load_scenario("touches", QUARTZ)
    assert sorted(site or 0 for site in scenario.site_ids) == list(range(1, 17))
    force = scenario.at(np.arange(0.0, 32.0, 0.01)).force_newton[..., 2]
    assert (force.max(axis=0).min(), force.max()) == (0.2, 8.0)
    assert (force > 0).sum(axis=1).max() == 1
    assert (force[:100] == 0).all()


def test_press_and_shear_reaches_incipient_slip_at_1_newton() -> None:
    scenario = load_scenario("press-and-shear", SKIN)
    force = scenario.at(np.arange(0.0, 12.0, 0.01)).force_newton.sum(axis=1)
    ratio = np.hypot(*force[:, :2].T) / (0.5 * np.maximum(force[:, 2], 1e-9))
    assert ratio.max() == pytest.approx(0.9, abs=1e-3)
    assert force[:, 2].max() == pytest.approx(1.2)
    assert scenario.site_ids == (None,) * 4


def test_still_held_between_and_too_hard_are_what_they_are_called() -> None:
    assert forces(load_scenario("still", QUARTZ), 0.0, 10.0) == [[], []]
    held = load_scenario("held", QUARTZ)
    assert [sum(row) for row in forces(held, 0.0005, 2.9, 3.3, 5.5)] == [1.0, 1.0, 0.0, 1.0]
    assert load_scenario("between", QUARTZ).site_ids == (None,) * 4
    peaks = load_scenario("too-hard", QUARTZ).peak_newton
    assert peaks.min() < QUARTZ.force_max_newton < peaks.max()


def test_a_position_on_a_site_is_that_site() -> None:
    touch = Touch(start_s=0.0, position_mm=(-0.5, 2.0), force_newton=1.0)
    assert Scenario((touch,), None, QUARTZ).site_ids == (7,)
    beside = touch.model_copy(update={"position_mm": (-0.5, 2.001)})
    assert Scenario((beside,), None, QUARTZ).site_ids == (None,)


def findings(tmp_path: Path, text: str) -> list[str]:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"mine\.toml") as caught:
        load_scenario(str(path), QUARTZ)
    return str(caught.value).replace(str(path), "mine.toml").splitlines()


def test_every_mistake_in_a_file_is_named(tmp_path: Path) -> None:
    lines = findings(
        tmp_path,
        "period = 3\n[[touches]]\nstart_s = 0\nsite = 1\nforce_newton = -1\nhold = 2\n"
        '[[touches]]\nsite = 2\nforce_newton = "1 N"\nshear = { peak_ratio = 2, directon_deg = 1 }\n',
    )
    assert "mine.toml: period: unknown key; did you mean period_s?" in lines
    assert "mine.toml: touches[0].force_newton: got -1; input should be greater than 0" in lines
    assert "mine.toml: touches[0].hold: unknown key; did you mean hold_s?" in lines
    assert "mine.toml: touches[1].start_s: field required" in lines
    assert "mine.toml: touches[1].force_newton: got '1 N'; input should be a valid number" in lines
    assert "mine.toml: touches[1].shear.peak_ratio: got 2; input should be less than or equal to 1" in lines
    assert "mine.toml: touches[1].shear.directon_deg: unknown key; did you mean direction_deg?" in lines
    assert len(lines) == 7


def test_a_scenario_that_does_not_fit_the_plate_is_refused(tmp_path: Path) -> None:
    touch = "[[touches]]\nstart_s = 0\nforce_newton = 1\n"
    lines = findings(
        tmp_path,
        "period_s = 2.0\n"
        f"{touch}site = 17\n{touch}position_mm = [11, 0]\n{touch}\n{touch}site = 1\nposition_mm = [0, 0]\n"
        f"{touch}site = 1\nhold_s = 3\n",
    )
    assert lines == [
        "mine.toml: touches[0].site: got 17; plate quartz16 has 1 to 16",
        "mine.toml: touches[1].position_mm: got [11.0, 0.0]; plate quartz16 reaches over x -10 to 10, y -10 to 10",
        "mine.toml: touches[2]: give either site or position_mm",
        "mine.toml: touches[3]: give either site or position_mm",
        "mine.toml: touches[4]: lasts 3.2 s; at most one period_s, 2 s",
    ]


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'touch'; did you mean touches"):
        load_scenario("touch", QUARTZ)
    with pytest.raises(ValueError, match="cannot be read"):
        load_scenario(str(tmp_path), QUARTZ)
    assert "not TOML" in findings(tmp_path, "[[touches]\n")[0]
