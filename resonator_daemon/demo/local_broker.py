"""A broker for a measurement: Mosquitto as a child process where it is installed, else the embedded one."""

import asyncio
import os
import shutil
import socket
from asyncio.subprocess import DEVNULL
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from resonator_daemon.errors import OperatorError
from resonator_daemon.publishing.embedded_broker import embedded_broker

_START_S = 5.0
_LOOK_S = 0.05
_STOP_S = 2.0


@asynccontextmanager
async def local_broker(folder: Path) -> AsyncIterator[tuple[str, str]]:
    """Serve on the loopback interface as long as the context lasts; yield the broker's name and URL.

    Raises
    ------
    OperatorError
        There is no Mosquitto and no amqtt either, or Mosquitto does not start.
    """
    # A user's PATH on Debian lacks the place of mosquitto.
    program = shutil.which("mosquitto", path=os.environ.get("PATH", "") + ":/usr/local/sbin:/usr/sbin")
    if program is None:
        async with embedded_broker() as url:
            yield "amqtt, as there is no Mosquitto", url
        return
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    settings = folder / "mosquitto.conf"
    # Without nodelay, messages wait for the acknowledgement of those before them.
    settings.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\nset_tcp_nodelay true\npersistence false\n")
    process = await asyncio.create_subprocess_exec(
        program, "-c", str(settings), stdin=DEVNULL, stdout=DEVNULL, stderr=DEVNULL, start_new_session=True
    )
    try:
        await _answering(port, process)
        yield "Mosquitto", f"mqtt://127.0.0.1:{port}"
    finally:
        if process.returncode is None:
            process.terminate()
        try:
            async with asyncio.timeout(_STOP_S):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()


async def _answering(port: int, process: asyncio.subprocess.Process) -> None:
    try:
        async with asyncio.timeout(_START_S):
            while process.returncode is None:
                try:
                    _, writer = await asyncio.open_connection("127.0.0.1", port)
                except OSError:
                    await asyncio.sleep(_LOOK_S)
                else:
                    writer.close()
                    return
    except TimeoutError:
        raise OperatorError(f"Mosquitto does not listen on port {port} within {_START_S:g} s") from None
    raise OperatorError(f"Mosquitto ended at once with exit code {process.returncode}; is port {port} taken?")
