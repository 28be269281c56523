"""What a calibration asks for, and what it refuses to ask for."""

import re
from dataclasses import replace

import pytest
from emulated_loads import NOMINAL

from resonator_daemon.base.errors import UsageError
from resonator_daemon.tools.calibration.steps import LoadRequest, plan_steps

USUAL = LoadRequest(sites=(7, 1))


def test_each_mass_on_each_site_in_the_order_asked_for() -> None:
    steps = plan_steps(USUAL, NOMINAL)
    assert [(step.number, step.site_id, step.mass_kg) for step in steps] == [
        (1, 7, 0.05), (2, 7, 0.2), (3, 7, 0.5), (4, 1, 0.05), (5, 1, 0.2), (6, 1, 0.5)
    ]  # fmt: skip
    assert steps[1].force_newton == pytest.approx(1.96133)  # 200 g at standard gravity
    assert not any(step.continues for step in steps)
    assert len(plan_steps(replace(USUAL, sites=()), NOMINAL)) == 48
    assert len(plan_steps(replace(USUAL, repeats=2), NOMINAL)) == 12


def test_a_response_goes_up_and_down_without_releasing_the_site() -> None:
    steps = plan_steps(replace(USUAL, sites=(3,), response=True), NOMINAL)
    assert [step.mass_kg for step in steps] == [0.05, 0.2, 0.5, 0.2, 0.05]
    assert [step.continues for step in steps] == [False, True, True, True, True]
    assert {step.hold_s for step in steps} == {60.0}


def test_a_sweep_comes_last_with_the_heaviest_mass() -> None:
    steps = plan_steps(replace(USUAL, kelvin=295.0, temperatures_kelvin=(300.0, 305.0)), NOMINAL)
    assert {step.kelvin for step in steps[:6]} == {295.0}
    assert [(step.site_id, step.mass_kg, step.kelvin) for step in steps[6:]] == [
        (7, 0.5, 300.0), (1, 0.5, 300.0), (7, 0.5, 305.0), (1, 0.5, 305.0)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("wanted", "option", "values"),
    [
        ({"sites": (7, 17)}, "--sites", "17 1 16"),
        ({"masses_kg": (0.2, 0.05)}, "--masses-grams", "50 200"),
        ({"masses_kg": (0.0, 0.2)}, "--masses-grams", "0 0"),
        ({"masses_kg": (0.5, 1.1)}, "--masses-grams", "1100 10.79 10 1020"),
        ({"masses_kg": ()}, "--masses-grams", ""),
        ({"masses_kg": (0.2,), "response": True}, "--masses-grams", "1 2"),
        ({"mass_std": 0.06}, "--mass-std", "0.06 0 0.05"),
        ({"mass_std": float("nan")}, "--mass-std", "0 0.05"),
        ({"repeats": 0}, "--repeats", "0 1 1000"),
        ({"hold_s": 0.1}, "--hold-s", "0.1 0.2 3600"),
        ({"kelvin": 290.0, "temperatures_kelvin": (300.0, 300.0)}, "--temperatures-kelvin", ""),
    ],
)
def test_impossible_requests_are_refused_with_value_and_limit(
    wanted: dict[str, object], option: str, values: str
) -> None:
    with pytest.raises(UsageError) as refusal:
        plan_steps(replace(USUAL, **wanted), NOMINAL)
    (message,) = refusal.value.messages
    assert message.partition(": ")[0] == option
    assert re.findall(r"(?<![\w'])\d+(?:\.\d+)?\b", message) == values.split()
