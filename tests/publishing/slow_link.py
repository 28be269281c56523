"""A way to a broker that takes so many bytes a second and no more."""

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from urllib.parse import urlsplit

_TICK_S = 0.05


@asynccontextmanager
async def slow_link(url: str, bytes_per_s: int) -> AsyncIterator[str]:
    """Yield the address of a proxy before a broker; what comes back is not slowed down."""
    port = urlsplit(url).port
    pipes: set[asyncio.Task[None]] = set()

    async def pipe(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, pause_s: float) -> None:
        try:
            while data := await reader.read(round(bytes_per_s * _TICK_S)):
                writer.write(data)
                await asyncio.sleep(pause_s)
        except ConnectionError:
            pass
        finally:
            writer.close()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        from_broker, to_broker = await asyncio.open_connection("127.0.0.1", port)
        for task in (
            asyncio.create_task(pipe(reader, to_broker, _TICK_S)),
            asyncio.create_task(pipe(from_broker, writer, 0.0)),
        ):
            pipes.add(task)
            task.add_done_callback(pipes.discard)

    listener = socket.create_server(("127.0.0.1", 0))
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)  # a slow network holds less than a slow reader
    server = await asyncio.start_server(serve, sock=listener, limit=1024)
    yield f"mqtt://127.0.0.1:{listener.getsockname()[1]}"
    server.close()
    for task in tuple(pipes):
        task.cancel()
    if pipes:
        await asyncio.wait(tuple(pipes))
