"""The status and the metrics of a whole daemon, over a pulled cable."""

import asyncio
import logging
import os
import urllib.request
from importlib.metadata import version
from itertools import pairwise

import pytest
from brokers import Mosquitto, free_port
from prometheus_client.parser import text_string_to_metric_families
from service_bench import Bench

from resonator_daemon.base.host.files import runtime_directory
from resonator_daemon.daemon.monitoring.status import Status
from resonator_daemon.daemon.service.daemon import Service
from resonator_daemon.mqtt.payloads import Condition
from simulators.faults import parse_faults

DEADLINE_S = 30.0

Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


def service_with_metrics(bench: Bench, port: int) -> Service:
    bench.broker_url = bench.broker_url.replace("mqtt://", "mqtt://robot:secret@")
    return bench.service(tables=("[metrics]", f'listen = "127.0.0.1:{port}"'))


async def ask_status() -> Status:
    path = runtime_directory("board") / "status.sock"
    async with asyncio.timeout(DEADLINE_S):
        while True:
            try:
                reader, writer = await asyncio.open_unix_connection(path)
            except (FileNotFoundError, ConnectionRefusedError):
                await asyncio.sleep(0.001)  # it is not up yet
                continue
            try:
                return Status.model_validate_json(await reader.read(-1))
            finally:
                writer.close()


def scrape(port: int) -> tuple[Samples, set[str]]:
    """Return the samples, and which families are counters."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=DEADLINE_S) as response:
        families = list(text_string_to_metric_families(response.read().decode()))
    counters = {sample.name for family in families if family.type == "counter" for sample in family.samples}
    samples = {(s.name, frozenset(s.labels.items())): s.value for family in families for s in family.samples}
    return samples, counters


async def test_counters_go_on_over_a_pulled_cable_and_the_status_reports_it(bench: Bench, mosquitto: Mosquitto) -> None:
    port = free_port()
    scrapes: list[Samples] = []
    async with (
        bench.emulated(scenario="still", faults=parse_faults("unplug_at_s=1.0,unplug_for_s=0.5")),
        bench.running(service_with_metrics(bench, port)),
    ):
        status = await ask_status()
        async with asyncio.timeout(DEADLINE_S):
            while not (status.link and status.link.last_outage and status.link.state is Condition.ONLINE
                       and status.health and status.health.connections == 2):  # fmt: skip
                samples, counters = await asyncio.to_thread(scrape, port)
                scrapes.append(samples)
                status = await ask_status()
        samples, counters = await asyncio.to_thread(scrape, port)
        scrapes.append(samples)
    assert not (runtime_directory("board") / "status.sock").exists()

    daemon = frozenset({("daemon", "board")})
    for earlier, later in pairwise(scrapes):
        fell = {key for key in earlier.keys() & later.keys() if key[0] in counters and later[key] < earlier[key]}
        assert not fell
    assert {samples["resonatord_link_up", daemon] for samples in scrapes} == {0.0, 1.0}
    assert scrapes[-1]["resonatord_link_connections_total", daemon] == 2
    lost = {dict(labels)["cause"]: value for (name, labels), value in scrapes[-1].items()
            if name == "resonatord_frames_lost_total"}  # fmt: skip
    assert {cause: count for cause, count in lost.items() if count} == status.health.lost.model_dump(
        exclude={"publish_dropped", "skipped_late"}
    )
    assert sum(lost.values()) > 300

    assert (status.name, status.instance, status.pid, status.version) == (
        "hand",
        "board",
        os.getpid(),
        version("resonatord"),
    )
    assert status.broker.url == mosquitto.url
    assert status.broker.connected
    assert {"started", "config", "daemon", "link", "outage", "connected"} <= status.ages_s.keys()
    assert all(0 <= age_s <= status.ages_s["started"] for age_s in status.ages_s.values())
    assert (status.config.in_use, status.config.problems) == ("file", ())
    assert status.health.frames > 1000
    assert "secret" not in status.model_dump_json()


async def test_hundreds_of_damaged_frames_are_figures_and_no_lines_of_the_log(
    bench: Bench, mosquitto: Mosquitto, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    faults = parse_faults("bit_error_rate=2e-4")
    service = service_with_metrics(bench, free_port())
    async with bench.emulated(scenario="still", faults=faults), bench.running(service), asyncio.timeout(DEADLINE_S):
        status = await ask_status()
        while not (status.health and status.health.lost.damaged > 300):
            await asyncio.sleep(0.1)
            status = await ask_status()
    assert len(caplog.records) < 100
