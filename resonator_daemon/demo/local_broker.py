"""A broker as a child process: Mosquitto where it is installed, else amqtt."""

import asyncio
import os
import shutil
import socket
from asyncio.subprocess import PIPE
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from resonator_daemon.demo.processes import PYTHON, Child, start_child, stopped_on_error
from resonator_daemon.errors import UserError

BROKER_PART: Final = "broker"
_START_S: Final = 5.0
_LOOK_S: Final = 0.05
# Where Debian installs mosquitto; a user's PATH lacks it.
MORE_PLACES = f"{os.pathsep}/usr/local/sbin{os.pathsep}/usr/sbin"


@dataclass(frozen=True, slots=True)
class LocalBroker:
    """A broker on the loopback interface; its name is `mosquitto` or `amqtt`."""

    name: str
    url: str
    child: Child


@asynccontextmanager
async def local_broker(folder: Path) -> AsyncIterator[LocalBroker]:
    """Run a broker on the loopback interface within the context; its configuration and log are in the folder.

    Raises
    ------
    UserError
        Neither Mosquitto nor amqtt is installed, or the broker does not start.
    """
    program = shutil.which("mosquitto", path=os.environ.get("PATH", "") + MORE_PLACES)
    broker = await (_start_amqtt(folder) if program is None else _start_mosquitto(program, folder))
    try:
        yield broker
    finally:
        await broker.child.stop()


async def _start_amqtt(folder: Path) -> LocalBroker:
    command = (*PYTHON, "resonator_daemon.publishing.embedded_broker")
    child = await start_child(BROKER_PART, folder, command, stdout=PIPE)
    async with stopped_on_error(child):
        return LocalBroker("amqtt", (await child.first_line()).decode().strip(), child)


async def _start_mosquitto(program: str, folder: Path) -> LocalBroker:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    settings = folder / "mosquitto.conf"
    # Without nodelay, messages wait for the acknowledgement of those before them.
    settings.write_text(
        f"listener {port} 127.0.0.1\nallow_anonymous true\nset_tcp_nodelay true\npersistence false\nlog_type error\n"
        "user root\n"  # applies to root alone: after a change of its user, it would not end with the demo
    )
    child = await start_child(BROKER_PART, folder, (program, "-c", str(settings)))
    async with stopped_on_error(child):
        try:
            async with asyncio.timeout(_START_S):
                while (failure := child.failure()) is None:
                    try:
                        _, writer = await asyncio.open_connection("127.0.0.1", port)
                    except OSError:
                        await asyncio.sleep(_LOOK_S)
                    else:
                        writer.close()
                        return LocalBroker("mosquitto", f"mqtt://127.0.0.1:{port}", child)
        except TimeoutError:
            raise UserError(f"Mosquitto does not listen on port {port} within {_START_S:g} s") from None
    raise UserError(f"{failure}; is port {port} taken?")
