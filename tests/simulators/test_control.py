"""Pressing an emulated plate while it runs: requests and refusals, the socket, and what frames and truth have of it."""

import json
import os
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from emulation import emulated
from scenarios import steady
from wire_host import Host, opened, truths

from resonator_daemon.base.plate import Plate, load_plate
from simulators.comb_plate import CombPlate
from simulators.control import CLIENTS_MAX, LINE_BYTES_MAX
from simulators.emulator import Emulator, EmulatorOptions
from simulators.physics import Physics
from simulators.plate import Contact, EmulatedPlate
from simulators.presses import FIRST_ID, TOUCHES_MAX, Presses
from simulators.quartz_plate import QuartzPlate
from simulators.scenario import Scenario
from simulators.skin_plate import SkinPlate
from simulators.world import World

QUARTZ, COMB, SKIN = load_plate("quartz16"), load_plate("comb16"), load_plate("skin32")
TAIL_BYTES = 4096  # more than a line of the truth
IDEAL = Physics(ideal=True)
PLACE, OTHER = [0.0012, -0.0031], [-0.0005, 0.002]  # the other is that of site 7
PRESS = {"press": "a", "position_m": PLACE, "force_newton": [0.0, 0.0, 1.0]}


def ask(presses: Presses, request: object, client: int = 0) -> dict[str, Any]:
    line = request if isinstance(request, bytes) else json.dumps(request).encode()
    return presses.request(client, line)


def code_of(answer: dict[str, Any]) -> str | None:
    return None if answer["ok"] else answer["error"]["code"]


class Client:
    """A client of a control socket that waits for each answer."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(20.0)
        self.socket.connect(os.fspath(path))
        self._lines = self.socket.makefile("rb")

    def ask(self, request: object) -> dict[str, Any]:
        self.socket.sendall((request if isinstance(request, bytes) else json.dumps(request).encode()) + b"\n")
        return self.answer()

    def answer(self) -> dict[str, Any]:
        return json.loads(self._lines.readline())

    def close(self) -> None:
        self._lines.close()
        self.socket.close()


@contextmanager
def pressed(tmp_path: Path, plate: str = "quartz16") -> Iterator[tuple[Emulator, Host, Path]]:
    """Run an emulator with a control socket and a host."""
    control, board = tmp_path / "control", tmp_path / "board"
    options = EmulatorOptions(plate, pty=board, control=control, truth=tmp_path / "truth.jsonl")
    gate_ticks = round(250e6 / load_plate(plate).counter.frame_rate_hz)
    with emulated(options) as emulator, opened(board, gate_ticks) as host:
        yield emulator, host, control


def forces_at_last(tmp_path: Path) -> list[float]:
    """Return the normal forces of the last truth; reads the end of the file alone, so that the emulator keeps up."""
    with (tmp_path / "truth.jsonl").open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL_BYTES))
        *_, last, _ = [b"", b"", *file.read().split(b"\n")]
    return [contact["force_newton"][2] for contact in json.loads(last)["contacts"]] if last else []


@pytest.mark.parametrize(("plate", "kind"), [(QUARTZ, QuartzPlate), (COMB, CombPlate)], ids=["quartz16", "comb16"])
def test_a_press_acts_on_sites_as_a_touch_of_a_scenario_does(
    plate: Plate, kind: type[QuartzPlate] | type[CombPlate]
) -> None:
    presses = Presses(plate, "EMU-0001")
    touches = (steady(1.5, position_mm=(1.2, -3.1)), steady(0.5, position_mm=tuple(np.array(OTHER) * 1e3)))
    by_scenario: EmulatedPlate = kind(plate, Scenario(touches, None, plate, physics=IDEAL), 3)
    by_client: EmulatedPlate = kind(plate, Scenario((), None, plate, physics=IDEAL, presses=presses), 3)
    lifted: EmulatedPlate = kind(plate, Scenario(touches[:1], None, plate, physics=IDEAL, presses=presses), 3)
    ask(presses, PRESS | {"position_m": OTHER, "force_newton": [0.1, 0.0, 0.5]})
    ask(presses, PRESS | {"press": "b", "force_newton": [0.0, 0.0, 1.5]})
    expected, found = by_scenario.count(0, 10**6, 10**6, 8), by_client.count(0, 10**6, 10**6, 8)
    assert [frame.channels for frame in found] == [frame.channels for frame in expected]
    assert [frame.channels for frame in lifted.count(0, 10**6, 10**6, 8)] == [frame.channels for frame in expected]
    contacts = sorted(found[0].contacts, key=lambda contact: contact.id)
    assert [(contact.id, contact.site, list(contact.position_m)) for contact in contacts] == [
        (FIRST_ID, 7, OTHER),
        (FIRST_ID + 1, None, PLACE),
    ]
    assert contacts[0].force_newton == (0.1, 0.0, 0.5)
    ask(presses, {"release": "a"})
    ask(presses, {"release": "b"})
    assert [[contact.id for contact in frame.contacts] for frame in lifted.count(0, 9 * 10**6, 10**6, 1)] == [[1]]
    assert [frame.contacts for frame in by_client.count(0, 9 * 10**6, 10**6, 2)] == [[], []]


def test_under_a_skin_a_press_has_radius_and_friction_and_slips_in_part() -> None:
    presses = Presses(SKIN, "EMU-0001")
    plate = SkinPlate(World(SKIN), Scenario((), None, SKIN, presses=presses), 3)

    def contact() -> Contact:
        ((found,),) = (frame.contacts for frame in plate.count(0, 10**6, 2_500_000, 1))
        return found

    shear = 0.875 * 0.5 * 0.512
    press = PRESS | {"force_newton": [0.0, shear, 0.512]}
    assert ask(presses, press) == {"ok": True, "press": "a", "contact_id": FIRST_ID, "slides": False}
    by_the_force = contact()
    assert by_the_force.force_newton == (0.0, shear, 0.512)
    assert by_the_force.radius_m == pytest.approx(2.5e-3 * 0.8)
    assert by_the_force.stick_radius_m == pytest.approx(2.5e-3 * 0.8 * 0.5)  # (1 - 0.875)^(1/3)
    assert by_the_force.friction_coefficient == 0.5
    assert ask(presses, {"press": "a", "radius_m": 1.5e-3, "friction_coefficient": 0.4})["slides"]
    given = contact()
    assert given.radius_m == pytest.approx(1.5e-3)
    assert given.stick_radius_m == 0.0
    assert given.force_newton == pytest.approx((0.0, 0.4 * 0.512, 0.512))  # friction bears no more
    ask(presses, {"press": "a", "radius_m": None, "friction_coefficient": 0.5})
    assert contact() == by_the_force
    touch = steady(0.512, position_mm=(1.2, -3.1), shear={"peak_ratio": 0.875, "direction_deg": 90.0}, hold_s=2.0)
    by_scenario = SkinPlate(World(SKIN), Scenario((touch,), None, SKIN), 3)
    by_client = SkinPlate(World(SKIN), Scenario((), None, SKIN, presses=presses), 3)
    middle_ticks = round(250e6 * (1.0 + 1.5e-6)) - 1_250_000  # the shear is largest in the middle of the hold
    expected, found = (each.count(0, middle_ticks, 2_500_000, 1)[0] for each in (by_scenario, by_client))
    assert found.channels == expected.channels


@pytest.mark.parametrize(
    ("given", "code"),
    [
        ({"radius_m": 0.0}, "radius_out_of_range"),
        ({"radius_m": 9e-3}, "radius_out_of_range"),
        ({"friction_coefficient": -0.1}, "friction_out_of_range"),
        ({"friction_coefficient": 2.1}, "friction_out_of_range"),
    ],
)
def test_radius_and_friction_have_limits_and_belong_to_skins(given: dict[str, float], code: str) -> None:
    assert code_of(ask(Presses(SKIN, "EMU-0001"), PRESS | given)) == code
    assert code_of(ask(Presses(QUARTZ, "EMU-0001"), PRESS | given)) == "no_skin"


def test_keys_that_are_not_given_stay_and_touches_belong_to_their_clients() -> None:
    presses = Presses(QUARTZ, "EMU-0001")
    assert ask(presses, PRESS) == {"ok": True, "press": "a", "contact_id": FIRST_ID}
    assert ask(presses, {"press": "a", "force_newton": [0, 0, 2]})["contact_id"] == FIRST_ID
    assert ask(presses, {"press": "a", "position_m": OTHER})["ok"]
    assert ask(presses, PRESS, client=1)["contact_id"] == FIRST_ID + 1
    pressing = presses.at(3)
    assert pressing.force_newton[..., 2].tolist() == [[2.0, 1.0]] * 3
    assert pressing.position_m[2].tolist() == [OTHER, PLACE]
    presses.release_all(0)
    assert code_of(ask(presses, {"release": "a"})) == "not_pressed"
    assert ask(presses, {"release": "a"}, client=1) == {"ok": True, "release": "a", "contact_id": FIRST_ID + 1}
    assert ask(presses, PRESS)["contact_id"] == FIRST_ID + 2
    assert presses.at(1).ids.tolist() == [[FIRST_ID + 2]]


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        (b"press!", "not_json"),
        (b'{"press": "a"', "not_json"),
        (b"\xff\xfe", "not_json"),
        (b"[" * 4000, "not_json"),
        ([PRESS], "no_verb"),
        ({}, "no_verb"),
        ({"press": "a", "release": "a"}, "no_verb"),
        ({"press": "a", "force_newton": [0, 0, 1]}, "missing_key"),
        (PRESS | {"pressure": 1}, "unknown_key"),
        (PRESS | {"press": 7}, "bad_value"),
        (PRESS | {"press": ""}, "bad_value"),
        (PRESS | {"force_newton": [0, 1]}, "bad_value"),
        (PRESS | {"force_newton": [0, 0, "1"]}, "bad_value"),
        (PRESS | {"force_newton": [0, 0, True]}, "bad_value"),
        (b'{"press": "a", "position_m": [0, NaN]}', "not_finite"),
        (b'{"press": "a", "position_m": [0, 0], "force_newton": [0, 0, 1e999]}', "not_finite"),
        (PRESS | {"position_m": [0.0101, 0.0]}, "outside_plate"),
        (PRESS | {"force_newton": [0, 0, -0.1]}, "force_out_of_range"),
        (PRESS | {"force_newton": [0, 0, 20.1]}, "force_out_of_range"),
        (PRESS | {"force_newton": [-20.1, 0, 1]}, "force_out_of_range"),
        ({"release": "b"}, "not_pressed"),
    ],
)
def test_a_request_that_is_refused_changes_nothing(request_: object, code: str) -> None:
    presses = Presses(QUARTZ, "EMU-0001")
    ask(presses, {"press": "held", "position_m": OTHER, "force_newton": [0, 0, 3.0]})
    assert code_of(ask(presses, request_)) == code
    assert presses.at(1).force_newton.tolist() == [[[0.0, 0.0, 3.0]]]


def test_touches_are_limited() -> None:
    presses = Presses(QUARTZ, "EMU-0001")
    answers = [ask(presses, PRESS | {"press": str(name)}, client=name % 2) for name in range(TOUCHES_MAX + 1)]
    assert [code_of(answer) for answer in answers] == [None] * TOUCHES_MAX + ["too_many_touches"]
    presses.release_all(1)
    assert ask(presses, PRESS | {"press": "more"})["ok"]


def test_the_example_of_the_page_presses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = Path(__file__).parents[2] / "docs" / "reference" / "emulator.md"
    (example,) = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    with pressed(tmp_path) as (_, host, control):
        assert control.stat().st_mode & 0o777 == 0o600
        host.read_until(lambda: len(host.frames) >= 20)
        exec(example.replace("/tmp/press", str(control)), {})
        host.read_until(lambda: forces_at_last(tmp_path) == [])
    assert not control.exists()
    first, refused, last = capsys.readouterr().out.splitlines()
    assert first == "{'ok': True, 'press': 'thumb', 'contact_id': 1000001}"
    assert refused == "outside_plate"
    assert last == "{'ok': True, 'release': 'thumb', 'contact_id': 1000001}"
    found = [line["contacts"][0]["force_newton"][2] for line in truths(tmp_path / "truth.jsonl") if line["contacts"]]
    assert [force for force in dict.fromkeys(found) if force != 0.5] == [1.0, 1.5, 2.0]  # 0.5 N lasts for an instant


def test_bad_lines_and_clients_end_nothing(tmp_path: Path) -> None:
    with pressed(tmp_path) as (_, host, control):
        clients = [Client(control) for _ in range(CLIENTS_MAX)]
        client = clients[0]
        assert code_of(client.ask(b"x" * (LINE_BYTES_MAX + 1))) == "line_too_long"
        assert code_of(client.ask(b"x" * 300_000)) == "line_too_long"
        client.socket.sendall(b"\n \n" + json.dumps(PRESS).encode())  # empty lines, and a line in two parts
        assert client.ask(b"")["ok"]
        clients.append(Client(control))
        assert code_of(clients[-1].answer()) == "too_many_clients"
        with pytest.raises(ConnectionError):  # it reads no answers
            clients[1].socket.sendall(b"{}\n" * 200_000)
        host.read_until(lambda: forces_at_last(tmp_path) == [1.0])
        for each in clients:
            each.close()
        host.read_until(lambda: forces_at_last(tmp_path) == [])


def test_the_socket_replaces_a_dead_one_and_nothing_else(tmp_path: Path) -> None:
    control = tmp_path / "control"
    options = EmulatorOptions("quartz16", tcp=("127.0.0.1", 0), control=control)
    with socket.socket(socket.AF_UNIX) as left_behind:
        left_behind.bind(os.fspath(control))
    with emulated(options), pytest.raises(FileExistsError):
        Emulator(options)
    control.write_text("mine")
    with pytest.raises(FileExistsError):
        Emulator(options)
    assert control.read_text() == "mine"
