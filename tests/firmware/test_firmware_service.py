"""`resonatord run` against the board program: the touch that it makes is found on its site."""

import asyncio
import json
import sys
from pathlib import Path
from urllib.parse import urlsplit

import aiomqtt
import pytest
from listener import DEADLINE_S
from switch import Switch

from resonator_daemon.board.links.carriers.tcp import TcpTarget
from resonator_daemon.mqtt.embedded_broker import embedded_broker

pytestmark = pytest.mark.firmware

PRESSED_SITE, FORCE_NEWTON = 13, 2.0


@pytest.mark.parametrize("switch", ["tcp"], indirect=True)
async def test_the_touch_is_found_with_its_force(switch: Switch, tmp_path: Path) -> None:
    assert isinstance(switch.link, TcpTarget)
    async with embedded_broker() as url:
        broker = urlsplit(url)
        config = tmp_path / "board.toml"
        config.write_text(
            f'name = "hand"\nplate = "quartz16"\nlink = "tcp://{switch.link.host}:{switch.link.port}"\n'
            f'[mqtt]\nurl = "{url}"\n[decoding]\nmethod = "off"\n'
        )
        async with aiomqtt.Client(broker.hostname or "", broker.port or 1883) as client:
            await client.subscribe("resonator/hand/forces")
            command = Path(sys.executable).with_name("resonatord")
            daemon = await asyncio.create_subprocess_exec(command, "run", "--config", config)
            try:
                async with asyncio.timeout(DEADLINE_S):
                    forces = [await _held_touch(client)]
            finally:
                daemon.terminate()
                assert await daemon.wait() == 0
    assert forces == [pytest.approx(FORCE_NEWTON, abs=0.01)]


async def _held_touch(client: aiomqtt.Client) -> float:
    """Return the greatest force of one touch, and see that no other site is pressed."""
    greatest = 0.0
    async for message in client.messages:
        said = json.loads(bytes(message.payload))
        sites = [site for site in said["sites"] if site["status"] == "ok"]
        assert all(site["site"] == PRESSED_SITE for site in sites)
        if sites:
            greatest = max(greatest, sites[0]["force_newton"])
        elif greatest:
            break
    return greatest
