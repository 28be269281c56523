"""A TCP relay before a broker, which can cut connections and refuse MQTT 5."""

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from urllib.parse import urlsplit

_READ_BYTES = 65536
_UNSUPPORTED_VERSION = b"\x20\x03\x00\x84\x00"


class Relay:
    """Relay to the broker at a URL; `url` is its own."""

    def __init__(self, broker_url: str, refuse_mqtt_5: bool) -> None:
        self._port = urlsplit(broker_url).port
        self._refuse_mqtt_5 = refuse_mqtt_5
        self._pipes: set[asyncio.Task[None]] = set()
        self._writers: list[asyncio.StreamWriter] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"mqtt://127.0.0.1:{self._listener.getsockname()[1]}"

    def cut(self) -> None:
        """End all connections without a word to either side."""
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()

    async def start(self) -> asyncio.Server:
        return await asyncio.start_server(self._serve, sock=self._listener, limit=1024)

    async def stop(self) -> None:
        for task in tuple(self._pipes):
            task.cancel()
        if self._pipes:
            await asyncio.wait(tuple(self._pipes))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        first = b""
        if self._refuse_mqtt_5:
            first = await reader.readuntil(b"MQTT") + await reader.readexactly(1)
            if first[-1] == 5:
                writer.write(_UNSUPPORTED_VERSION)
                writer.close()
                return
        from_broker, to_broker = await asyncio.open_connection("127.0.0.1", self._port)
        self._writers += [writer, to_broker]
        to_broker.write(first)
        for one, other in ((reader, to_broker), (from_broker, writer)):
            task = asyncio.create_task(self._pipe(one, other))
            self._pipes.add(task)
            task.add_done_callback(self._pipes.discard)

    @staticmethod
    async def _pipe(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(_READ_BYTES):
                writer.write(data)
        except ConnectionError:
            pass
        finally:
            writer.close()


@asynccontextmanager
async def relay(broker_url: str, *, refuse_mqtt_5: bool = False) -> AsyncIterator[Relay]:
    made = Relay(broker_url, refuse_mqtt_5)
    server = await made.start()
    try:
        yield made
    finally:
        server.close()
        await made.stop()
