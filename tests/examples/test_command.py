"""docs/examples/python/command.py asks a daemon and prints its answer."""

import asyncio
import json
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import aiomqtt
import pytest
from example_programs import DEADLINE_S, EXAMPLES

from resonator_daemon.config import Mqtt


async def start(broker_url: str, *arguments: str) -> Process:
    at = Mqtt(url=broker_url)
    command = (EXAMPLES / "python" / "command.py", "left", *arguments, "--host", at.host, "--port", str(at.port))
    return await asyncio.create_subprocess_exec(sys.executable, *command, stdout=PIPE, stderr=PIPE)


@asynccontextmanager
async def asked(broker, *arguments: str) -> AsyncIterator[tuple[aiomqtt.Client, aiomqtt.Message, Process]]:
    """Start the example; yield the command as it comes to a daemon, and a client to answer with."""
    at = Mqtt(url=broker.url)
    async with asyncio.timeout(DEADLINE_S), aiomqtt.Client(at.host, at.port) as client:
        await client.subscribe("resonator/left/cmd/+", qos=1)
        program = await start(broker.url, *arguments)
        yield client, await anext(client.messages), program


@pytest.mark.parametrize("ok", [True, False])
async def test_the_answer_is_printed_and_the_exit_code_tells_whether_it_was_done(broker, ok: bool) -> None:
    async with asked(broker, "tare", '{"why": "new"}') as (daemon, command, program):
        assert command.topic.value == "resonator/left/cmd/tare"
        request = json.loads(command.payload)
        answer = {"verb": "tare", "ok": ok, "id": request.pop("id")}
        assert request == {"why": "new"}
        for each in ({"verb": "tare", "ok": not ok, "id": "of another"}, answer):
            await daemon.publish("resonator/left/rsp/tare", json.dumps(each), qos=1)
        said, _ = await program.communicate()
    assert json.loads(said) == answer
    assert program.returncode == (0 if ok else 1)


async def test_a_broker_that_is_not_there_is_told() -> None:
    program = await start("mqtt://127.0.0.1:9", "ping")
    _, said = await program.communicate()
    assert program.returncode == 1
    assert said.startswith(b"broker 127.0.0.1:9: ")
    assert said.count(b"\n") == 1
