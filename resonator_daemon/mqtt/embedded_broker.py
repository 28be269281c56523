"""A small MQTT 3.1.1 broker on the loopback interface, for the demo: in this process, or run as a module."""

import asyncio
import logging
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Final

from resonator_daemon.base.errors import MissingLibraryError
from resonator_daemon.base.host.text import how_to_install
from resonator_daemon.mqtt.embedded_delivery import Connection, StreamDelivery

SHUTDOWN_TIMEOUT_S: Final = 2.0


@asynccontextmanager
async def embedded_broker(port: int = 0) -> AsyncIterator[str]:
    """Serve anonymous clients as long as the context lasts; yield the broker's URL, on a free port unless one is given.

    Raises
    ------
    UserError
        amqtt, which the broker is made of, is not installed.
    """
    try:
        from amqtt.broker import Broker
    except ImportError as error:
        raise MissingLibraryError(f"the embedded broker needs amqtt: {how_to_install('amqtt')}") from error

    for name in ("amqtt", "transitions"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    # The listener is ours, not amqtt's, so that the port is known without choosing it beforehand.
    config = {
        "listeners": {"default": {"type": "external"}},
        "plugins": {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
    }
    broker = Broker(config)
    delivery = StreamDelivery(broker)
    serving: dict[asyncio.Task[None], asyncio.StreamWriter] = {}

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        connection = Connection(reader, writer, delivery)
        reading = asyncio.create_task(connection.read_on())
        try:
            await broker.external_connected(connection.reader, connection, "default")
        finally:
            reading.cancel()
            writer.close()
            delivery.subscriptions_changed()

    def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.create_task(serve(reader, writer))
        serving[task] = writer
        task.add_done_callback(serving.pop)

    await broker.start()
    server = await asyncio.start_server(accept, "127.0.0.1", port)
    try:
        yield f"mqtt://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    finally:
        server.close()
        # Connections first: amqtt's own shutdown cancels their readers, which do not always take notice.
        for writer in serving.values():
            writer.transport.abort()
        if serving:
            await asyncio.wait(serving, timeout=SHUTDOWN_TIMEOUT_S)
        await broker.shutdown()


async def _serve_until_stopped() -> None:
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with embedded_broker() as url:
        sys.stdout.write(url + "\n")
        sys.stdout.flush()
        await stop.wait()


if __name__ == "__main__":
    asyncio.run(_serve_until_stopped())
