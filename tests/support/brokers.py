"""Brokers that tests can kill, freeze and start again: Mosquitto in a child process, amqtt in this one."""

import abc
import os
import shutil
import signal
import socket
import subprocess
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Self
from urllib.parse import urlsplit

import aiomqtt
import pytest

from resonator_daemon.mqtt.embedded_broker import embedded_broker

_given_ports: set[int] = set()


def free_port() -> int:
    """Return an unused TCP port that was not returned before, since its user may not listen yet."""
    while True:
        with socket.create_server(("127.0.0.1", 0)) as probe:
            port: int = probe.getsockname()[1]
        if port not in _given_ports:
            _given_ports.add(port)
            return port


def client_of(url: str) -> aiomqtt.Client:
    """Return a client of the broker at `mqtt://HOST:PORT`."""
    at = urlsplit(url)
    return aiomqtt.Client(at.hostname or "", at.port or 1883)


async def publish(url: str, topic: str, payload: bytes | str, *, retain: bool = False) -> None:
    async with client_of(url) as client:
        await client.publish(topic, payload, qos=1, retain=retain)


class Broker(abc.ABC):
    """A broker that runs within its context, where it can be killed and started again."""

    @abc.abstractmethod
    async def start(self) -> None: ...

    @abc.abstractmethod
    async def kill(self) -> None: ...

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.kill()


class Mosquitto(Broker):
    """A Mosquitto that forgets everything when killed, and comes back on the same port."""

    def __init__(self, directory: Path, *settings: str, config: str | None = None) -> None:
        """One listener with these settings, or the whole of a configuration, which names its own."""
        self._command = shutil.which("mosquitto", path=os.environ.get("PATH", "") + ":/usr/sbin") or "mosquitto"
        self._config = directory / "mosquitto.conf"
        self._process: subprocess.Popen[str] | None = None
        port = free_port()
        self.url = f"mqtt://127.0.0.1:{port}"
        self.tls_url = f"mqtts://localhost:{port}"
        settings = settings or ("allow_anonymous true",)
        always = ("user root", "log_dest stderr", "log_type error", "log_type information", "connection_messages false")
        if config is None:
            config = "\n".join((f"listener {port} 127.0.0.1", "set_tcp_nodelay true", *settings))
        self._config.write_text("\n".join((config, *always)) + "\n")

    async def start(self) -> None:
        self._launch()

    def _launch(self) -> None:
        self._process = subprocess.Popen([self._command, "-c", str(self._config)], stderr=subprocess.PIPE, text=True)
        assert self._process.stderr is not None
        said = []
        for line in self._process.stderr:
            said.append(line)
            if "running" in line:
                return
        pytest.fail(f"mosquitto did not start: {said}")

    async def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def freeze(self) -> None:
        self._signal(signal.SIGSTOP)

    def thaw(self) -> None:
        self._signal(signal.SIGCONT)

    def _signal(self, number: int) -> None:
        assert self._process is not None
        self._process.send_signal(number)


class Amqtt(Broker):
    """The embedded broker, restartable like Mosquitto."""

    def __init__(self) -> None:
        self._port = free_port()
        self._running = AsyncExitStack()
        self.url = f"mqtt://127.0.0.1:{self._port}"

    async def start(self) -> None:
        await self._running.enter_async_context(embedded_broker(self._port))

    async def kill(self) -> None:
        await self._running.aclose()
