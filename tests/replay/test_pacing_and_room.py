"""How fast recorded time passes, and that a broker which cannot keep up is waited for."""

from pathlib import Path

import pytest
from brokers import Mosquitto
from observer import observe

from resonator_daemon.config import Mqtt
from resonator_daemon.publishing import outbox
from resonator_daemon.replay.broker import AtBroker
from resonator_daemon.replay.recorded_pipeline import Moment
from resonator_daemon.replay.run import AtSpeed
from resonator_daemon.replay.source import open_replay
from resonator_daemon.session.host_time import HostTime

TOUCHES = Path(__file__).parents[1] / "corpus" / "touches" / "recording.mcap"


def moment(monotonic_ms: int) -> Moment:
    return Moment(HostTime(monotonic_ms * 10**6, 0, 0))


async def test_time_passes_as_many_times_as_fast_from_the_first_moment_on() -> None:
    now_ns = 5 * 10**9
    waits: list[float] = []

    async def sleep(seconds: float) -> None:
        nonlocal now_ns
        waits.append(round(seconds, 6))
        now_ns += round(seconds * 1e9)

    pacing = AtSpeed(4.0, lambda: now_ns, sleep)
    for at_ms in (700, 1100, 1100, 5100):
        await pacing.wait_for(moment(at_ms))
    now_ns += 10**9  # what is late is not waited for
    await pacing.wait_for(moment(5200))
    await pacing.wait_for(moment(9700))
    assert waits == [0, 0.1, 0, 1.0, 0, 0.15]


async def test_nothing_is_dropped_for_want_of_room(mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outbox, "STREAMS_WAITING_MAX", 40)
    monkeypatch.setattr("resonator_daemon.replay.broker.WAITING_MAX", 20)
    async with observe(mosquitto.url) as heard:
        output = AtBroker(Mqtt(url=mosquitto.url), "hand", TOUCHES.name)
        count = 0
        with open_replay(TOUCHES, daemon_boot_id=output.daemon_boot_id) as replaying:
            async with output:
                for now in replaying.moments():
                    for published in now.messages:
                        await output.put(published)
                        count += published.topic.path == "forces"
        assert output.dropped == {}
        assert len(await heard.until_count("resonator/hand/forces", count)) == count > 100
