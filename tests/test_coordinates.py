"""docs/reference/coordinates.md holds from emulated plate to payload: each sign, each order of rows, by the truth.

Presses are off centre, with x and y of their own sizes and signs, and sheared in both directions, so that no axis can
be exchanged or reversed unseen. Expected moments are r x f by hand.
"""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import cbor2
import numpy as np
from brokers import Mosquitto
from observer import Observer, observe
from plates import SMALL_SKIN
from scenarios import IDEAL, touch_text
from service_bench import Bench

NY, NX, PITCH_M = 12, 16, 0.6e-3
SKIN = SMALL_SKIN.replace("shape = [16, 16]", f"shape = [{NY}, {NX}]")
PRESSED_NEWTON, SHEARED_NEWTON = 0.29, 0.07  # of 0.3 and up to 0.12

# Places in mm, each above a site, and where the shear points, in degrees from x towards y. (f_x, f_y) have all four
# pairs of signs, each component of the moment both signs.
PRESSES = (((1.5, -0.9), 60.0), ((-2.1, 0.9), 200.0), ((0.9, 1.5), -50.0), ((-0.9, -1.5), 130.0))


def sheared_presses() -> str:
    text = IDEAL.replace("[plate]", f"period_s = {0.5 + 1.5 * len(PRESSES)}\n[plate]")
    for number, ((x, y), degrees) in enumerate(PRESSES):
        shear = f"{{peak_ratio = 0.8, direction_deg = {degrees}}}"
        text += touch_text(0.5 + 1.5 * number, 0.3, 1.0, position_mm=[x, y], shear=shear)
    return text


def array_of(value: Any) -> np.ndarray:
    """Read an RFC 8746 array by hand."""
    shape, elements = value.value
    return np.frombuffer(elements.value, "<f4").reshape(shape)


class Sheared(NamedTuple):
    """A decoded message, and the only contact that is there truly, at rest and sheared."""

    message: Any
    position_m: list[float]
    force_newton: list[float]


def sheared(messages: Iterable[Any], bench: Bench) -> list[Sheared]:
    """Return those messages that are of one sheared contact; all presses are among them.

    A reason code with `ok` means that matrices are being prepared, and the map is a coarser one.
    """
    truth = {line["board_ticks"]: line["contacts"] for line in bench.truth()}
    found = []
    for message in messages:
        contacts = truth.get(int(message["board_ticks"]), [])
        regular = (message.get("status", "ok"), message.get("reason_code")) == ("ok", None)
        if regular and len(contacts) == 1:
            position_m, force_newton = contacts[0]["position_m"], contacts[0]["force_newton"]
            if force_newton[2] > PRESSED_NEWTON and np.hypot(*force_newton[:2]) > SHEARED_NEWTON:
                found.append(Sheared(message, position_m, force_newton))
    assert {tuple(np.round(np.multiply(each.position_m, 1e3), 3)) for each in found} == {place for place, _ in PRESSES}
    return found


def assert_net_loads_follow(contacts: list[Sheared]) -> None:
    for message, (x, y), (f_x, f_y, f_z) in contacts:
        (contact,) = message["contacts"]
        np.testing.assert_allclose(contact["position_m"], [x, y], atol=1.5e-4)
        np.testing.assert_allclose(contact["force_newton"], [f_x, f_y, f_z], atol=0.04)
        moment = [y * f_z, -x * f_z, x * f_y - y * f_x]  # r x f, r = (x, y, 0)
        np.testing.assert_allclose(contact["moment_newton_m"], moment, atol=6e-5)
        assert np.all(np.sign(contact["moment_newton_m"]) == np.sign(moment))


def assert_maps_follow(decoded: list[Sheared]) -> None:
    """Traction and displacement are greatest at the contact's pixel, and point as the force does."""
    for message, (x, y), (f_x, f_y, _) in decoded:
        column, row = pixel(x, y)
        middle_m = message["grid"]["origin_m"] + np.array([column, row]) * message["grid"]["pitch_m"]
        np.testing.assert_allclose(middle_m, [x, y], atol=1e-9)
        along = np.array([f_x, f_y]) / np.hypot(f_x, f_y)
        for key in ("traction_pascal", "displacement_m"):
            field = array_of(message[key])
            assert field.shape == (3, NY, NX)
            at_contact = field[:, row - 1 : row + 2, column - 1 : column + 2].mean(axis=(1, 2))
            assert at_contact[2] > 0.5 * field[2].max() > 0.0
            assert at_contact[:2] @ along > 0.9 * np.hypot(*at_contact[:2])


def assert_signals_follow(signals: list[Sheared]) -> None:
    """Beneath the contact the skin is compressed; its surface is dragged further than the site."""
    for message, (x, y), (f_x, f_y, _) in signals:
        column, row = pixel(x, y)
        under = array_of(message["signals"]).reshape(3, NY, NX)[:, row - 1 : row + 2, column - 1 : column + 2]
        assert np.all(np.sign(under.mean(axis=(1, 2))) == [-1, -np.sign(f_x), -np.sign(f_y)])


def pixel(x_m: float, y_m: float) -> tuple[int, int]:
    """Column and row of a place: row 0 has the least y, column 0 the least x, and the middle lies between pixels."""
    return round(x_m / PITCH_M + (NX - 1) / 2), round(y_m / PITCH_M + (NY - 1) / 2)


async def test_a_sheared_press_off_the_centre_keeps_every_sign(tmp_path: Path, mosquitto: Mosquitto) -> None:
    bench = Bench(tmp_path, mosquitto.url)
    plate = tmp_path / "oblong.toml"
    plate.write_text(SKIN)

    def all_decoded(observer: Observer) -> bool:
        """Whether the contacts of all presses have been seen, each in many frames."""
        seen = Counter(
            tuple(np.sign(contact["position_m"]))
            for message in observer.payloads("resonator/hand/contacts")
            for contact in message["contacts"]
            if "reason_code" not in message
            and contact["force_newton"][2] > 0.9 * PRESSED_NEWTON
            and np.hypot(*contact["force_newton"][:2]) > 1.2 * SHEARED_NEWTON
        )
        return sum(count > 5 for count in seen.values()) == len(PRESSES)

    async with (
        observe(mosquitto.url) as observer,
        bench.emulated(str(plate), scenario=bench.scenario(sheared_presses())) as emulator,
        bench.running(bench.service(str(plate), emulator.link.address, decoding="")),
    ):
        await observer.until(lambda: all_decoded(observer))

    assert_net_loads_follow(sheared(observer.payloads("resonator/hand/contacts"), bench))
    assert_maps_follow(sheared(map(cbor2.loads, observer.raw("resonator/hand/decoded")), bench))
    assert_signals_follow(sheared(map(cbor2.loads, observer.raw("resonator/hand/signals")), bench))
