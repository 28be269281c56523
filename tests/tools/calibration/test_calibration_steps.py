"""What a calibration asks for, and what it refuses to ask for."""

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
    ("wanted", "printed"),
    [
        ({"sites": (7, 17)}, "--sites: plate 'quartz16' has no site 17; it has 1 to 16"),
        ({"masses_kg": (0.2, 0.05)}, "--masses-grams: 50 g after 200 g; masses must rise"),
        ({"masses_kg": (0.0, 0.2)}, "--masses-grams: 0 g, must be above 0"),
        ({"masses_kg": (0.5, 1.1)}, "1100 g presses with 10.79 N, at most force_max_newton = 10 N, 1020 g"),
        ({"masses_kg": ()}, "--masses-grams: none given"),
        ({"masses_kg": (0.2,), "response": True}, "at least 2 for --response"),
        ({"mass_std": float("nan")}, "--mass-std: nan, must be"),
        ({"repeats": 0}, "--repeats: 0, must be between 1 and 1000"),
        ({"hold_s": 0.1}, "--hold-s: 0.1 s, must be between 0.2 and 3600"),
        ({"kelvin": 290.0, "temperatures_kelvin": (300.0, 300.0)}, "a temperature is named twice"),
    ],
)
def test_what_cannot_be_asked_for_is_refused_with_value_and_limit(wanted: dict[str, object], printed: str) -> None:
    with pytest.raises(UsageError) as refusal:
        plan_steps(replace(USUAL, **wanted), NOMINAL)
    assert printed in "\n".join(refusal.value.messages)
