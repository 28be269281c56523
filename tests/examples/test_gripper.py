"""The grip controller of docs/examples holds an object between two fingers, one of which is an emulated skin."""

import asyncio
import json
import os
import sys
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from brokers import Mosquitto
from example_programs import EXAMPLES
from observer import observe

pytestmark = pytest.mark.soak

GRAVITY = 9.81
MASS_KG = 0.05
FRICTION, FRICTION_AFTER = 0.5, 0.4
LIFTED_S, DROP_S, END_S = 1.0, 2.0, 4.0
SETTLED_S = 0.5  # after the lift, and after the drop
STEP_S = 0.005
FALLEN_M = 0.02  # of the way that the object may slide between the fingers


@dataclass
class Object:
    """What two fingers hold, each with half of the load; it slides where friction cannot bear it."""

    grip_newton: float = 0.4
    slid_m: float = 0.0
    speed_m_s: float = 0.0
    now_s: float = 0.0

    @property
    def friction(self) -> float:
        return FRICTION if self.now_s < DROP_S else FRICTION_AFTER

    @property
    def load_newton(self) -> float:
        """Of each finger: a table bears the rest until it is lifted."""
        return MASS_KG * GRAVITY / 2.0 * min(self.now_s / LIFTED_S, 1.0)

    @property
    def least_newton(self) -> float:
        """The least grip that holds."""
        return self.load_newton / self.friction

    def step(self, now_s: float) -> list[float]:
        """Go on to that time; return the force on a finger."""
        passed_s, self.now_s = now_s - self.now_s, now_s
        borne_newton = self.friction * self.grip_newton
        lacking_newton = self.load_newton - borne_newton
        self.speed_m_s = max(0.0, self.speed_m_s + 2.0 * lacking_newton / MASS_KG * passed_s)
        self.slid_m += self.speed_m_s * passed_s
        slides = self.speed_m_s > 0.0 or lacking_newton > 0.0
        return [0.0, borne_newton if slides else self.load_newton, self.grip_newton]


@asynccontextmanager
async def started(*command: str, stdout: int = DEVNULL) -> AsyncIterator[Process]:
    process = await asyncio.create_subprocess_exec(sys.executable, *command, stdout=stdout, stderr=DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        await process.communicate()


async def follow(controller: Process, held: Object) -> None:
    """Let the fingers press as the controller prints."""
    assert controller.stdout is not None
    async for line in controller.stdout:
        held.grip_newton = float(line.split()[1])


async def test_an_object_is_held_with_little_more_than_the_least_grip_also_when_its_friction_drops(
    tmp_path: Path, mosquitto: Mosquitto
) -> None:
    control, config = tmp_path / "control", tmp_path / "finger.toml"
    emulate = ("emulate", "--plate", "skin32", "--tcp", "127.0.0.1:0", "--control", str(control), "--json")
    async with (
        asyncio.timeout(120),
        observe(mosquitto.url) as heard,
        started("-m", "resonator_daemon.commands", *emulate, stdout=PIPE) as emulator,
    ):
        assert emulator.stdout is not None
        link = json.loads(await emulator.stdout.readline())["link"]
        config.write_text(f'name = "finger"\nplate = "skin32"\nlink = "{link}"\n[mqtt]\nurl = "{mosquitto.url}"\n')
        address = mosquitto.url.removeprefix("mqtt://").split(":")
        async with (
            started("-m", "resonator_daemon.commands", "run", "--config", str(config)),
            started(str(EXAMPLES / "python" / "gripper.py"), *address, "finger", stdout=PIPE) as controller,
        ):
            await heard.until_last("resonator/finger/contacts", contacts=[])
            held = Object()
            following = asyncio.create_task(follow(controller, held))
            reader, writer = await asyncio.open_unix_connection(os.fspath(control))
            loop = asyncio.get_running_loop()
            started_s, shares = loop.time(), []
            while (now_s := loop.time() - started_s) < END_S:
                force_newton = held.step(now_s)
                press = {"press": "object", "position_m": [0, 0], "force_newton": force_newton}
                writer.write(json.dumps(press | {"friction_coefficient": held.friction}).encode() + b"\n")
                assert json.loads(await reader.readline())["ok"]
                if now_s >= LIFTED_S:
                    shares.append((now_s, held.grip_newton / held.least_newton))
                await asyncio.sleep(STEP_S)
            following.cancel()
            writer.close()
    settled = [share for now_s, share in shares if (now_s - LIFTED_S) % (DROP_S - LIFTED_S) > SETTLED_S]
    highest = max(share for _, share in shares)
    measured = f"slid {held.slid_m * 1e3:.2f} mm; grip of the least {min(settled):.3f} to {highest:.3f}"
    assert held.speed_m_s == 0.0, measured
    assert held.slid_m < FALLEN_M, measured
    assert min(settled) > 1.0, measured
    assert highest < 1.3, measured
