"""docs/how-to/secure-the-broker.md: its commands make certificates that the example's broker and the daemon accept."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from brokers import Mosquitto

from resonator_daemon.board.config.mqtt import Mqtt
from resonator_daemon.mqtt.broker_connection import FAILURE, MQTT_5, BrokerConnection
from resonator_daemon.mqtt.connecting import BrokerError

PAGE = (Path(__file__).parents[2] / "docs" / "how-to" / "secure-the-broker.md").read_text()
COMMANDS = re.findall(r"<!-- runs in tests -->\n```sh\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
async def test_the_commands_of_the_page_make_certificates_that_work(tmp_path: Path) -> None:
    assert len(COMMANDS) == 3
    make_certificates(tmp_path)
    tls = (f"cafile {tmp_path}/ca.crt", f"certfile {tmp_path}/broker.crt", f"keyfile {tmp_path}/broker.key")
    client_certificates = ("require_certificate true", "use_identity_as_username true", "allow_anonymous false")
    rules = tmp_path / "acl"
    rules.write_text("pattern write %u\n")
    async with Mosquitto(tmp_path, *tls, *client_certificates, f"acl_file {rules}") as running:
        refused: dict[object, bool] = {}
        broker = mqtt(tmp_path, running.tls_url, "left-index")
        client = BrokerConnection(
            broker, MQTT_5, on_completed=lambda sent, code: refused.update({sent.token: code >= FAILURE})
        )
        await client.connect()
        for topic in ("left-index", "right-index"):
            client.send(topic, b"", qos=1, token=topic)
        await client.subscribe("left-index")
        await client.disconnect()
        assert refused == {"left-index": False, "right-index": True}
        with pytest.raises(BrokerError, match=r"mqtt\.certificate_file"):  # a broker's is no client's
            await BrokerConnection(mqtt(tmp_path, running.tls_url, "broker"), MQTT_5).connect()


def make_certificates(directory: Path) -> None:
    for command in COMMANDS:
        subprocess.run(["bash", "-euc", command], cwd=directory, check=True, capture_output=True)


def mqtt(directory: Path, url: str, name: str) -> Mqtt:
    return Mqtt(
        url=url,
        ca_file=str(directory / "ca.crt"),
        certificate_file=str(directory / f"{name}.crt"),
        key_file=str(directory / f"{name}.key"),
    )
