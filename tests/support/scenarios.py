"""Scenarios of tests: touches as objects, and the text of scenario files."""

from simulators.scenario_file import Touch

IDEAL = "[plate]\nideal = true\n"


def steady(force_newton: float = 1.0, *, start_s: float = 0.0, hold_s: float = 1000.0, **keys: object) -> Touch:
    """Return a touch that presses and releases in an instant."""
    return Touch(start_s=start_s, force_newton=force_newton, rise_s=0.0, hold_s=hold_s, fall_s=0.0, **keys)


def touch_text(start_s: float, force_newton: float, hold_s: float, **keys: object) -> str:
    """Return the [[touches]] of a scenario file, other values as TOML has them."""
    given = {"start_s": start_s, "force_newton": force_newton, "hold_s": hold_s} | keys
    return "[[touches]]\n" + "".join(f"{key} = {value}\n" for key, value in given.items())


def press_and_shear(start_s: float, hold_s: float) -> str:
    """Return a touch of a small skin, next to its middle, whose shear grows while it is held."""
    shear = "{ peak_ratio = 0.9, direction_deg = 30.0 }"
    return touch_text(start_s, 0.3, hold_s, position_mm=[0.2, -0.1], rise_s=0.3, fall_s=0.3, shear=shear)
