"""Plates of tests: shipped ones with other values, and plate files written out."""

import json
from typing import Any

from resonator_daemon.base.plate import Plate


def with_counter(plate: Plate, **values: float) -> Plate:
    """Return the plate with other values of its counter."""
    return plate.model_copy(update={"counter": plate.counter.model_copy(update=values)})


def with_tables(plate: Plate, **tables: Any) -> Plate:
    """Return the plate that a file with other tables describes."""
    return Plate.model_validate(plate.model_dump(mode="json", exclude_none=True) | tables)


def plate_head(
    name: str,
    low_mm: tuple[float, float],
    high_mm: tuple[float, float],
    force_max_newton: float = 10,
    kind: str = "single-tone",
    **counter: float,
) -> str:
    """Return the file of a rectangular plate, with a transducer in each corner, up to its [counter]."""
    (left, low), (right, high) = low_mm, high_mm
    corners = [[left, low], [right, low], [right, high], [left, high]]
    values = "".join(f"{key} = {json.dumps(value)}\n" for key, value in counter.items())
    return (
        f'format = 1\nname = "{name}"\noutline_mm = {corners}\ntransducers_mm = {corners}\n'
        f'force_max_newton = {force_max_newton}\n[counter]\nkind = "{kind}"\n{values}'
    )


def skin_table() -> str:
    return "[skin]\nyoungs_modulus_pascal = 2e5\npoisson_ratio = 0.5\ndepth_mm = 1.0\n"


def skin_grid(sites: int, pitch_mm: float, spacing_hz: float, order: tuple[int, int, int]) -> str:
    """Return the [grid] of a square skin, whose tones begin at 100 MHz."""
    return (
        f'[grid]\nshape = [{sites}, {sites}]\npitch_mm = {pitch_mm}\nsignals = ["p_n", "eps_xz", "eps_yz"]\n'
        f"f0_hz = 100e6\nspacing_hz = {spacing_hz}\norder = {list(order)}\nsensitivity = [-2.0e-11, 2.7e-6, 2.7e-6]\n"
    )


def site(number: int, x_mm: float, y_mm: float, **tones: tuple[float, float]) -> str:
    """Return a [[sites]] table; of each signal the frequency in Hz and the sensitivity, the same at all corners."""
    return f"[[sites]]\nid = {number}\nposition_mm = [{x_mm}, {y_mm}]\n" + "".join(
        f'[[sites.tones]]\nsignal = "{signal}"\nf0_hz = {[f0_hz] * 4}\nsensitivity = {[k] * 4}\n'
        for signal, (f0_hz, k) in tones.items()
    )


def small_skin(name: str, half_mm: float, force_max_newton: float, frame_rate_hz: float, sites: int) -> str:
    """Return the file of a square skin with sites 0.6 mm apart; tones in the order of signal, x, y."""
    head = plate_head(
        name, (-half_mm, -half_mm), (half_mm, half_mm), force_max_newton, "channelised",
        reference_hz=250e6, frame_rate_hz=frame_rate_hz,
    )  # fmt: skip
    return head + skin_table() + skin_grid(sites, 0.6, 13000, (3, 3 * sites, 1))


SMALL_SKIN = small_skin("small-skin", 4.8, 5, 50, 16)
