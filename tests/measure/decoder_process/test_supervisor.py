"""The decoder process as its daemon sees it: fed, restarted, exact in its counts, and gone with the daemon."""

import asyncio
import os
import signal
import sys
from itertools import pairwise

import numpy as np
import psutil
import pytest
from decoder_bench import NOISE, NU, SITES, SITES_M, E, pressed, until
from surface_bench import NOTHING, SKIN, Client, frame

from resonator_daemon.base.reasons import Reason, ReasonCode
from resonator_daemon.estimate.surface.skin import Skin
from resonator_daemon.measure.decoder_process import supervisor
from resonator_daemon.measure.sensors import surface_decoding
from simulators.half_space_fields import hertz_fields


async def test_frames_become_messages_of_their_topics_under_their_own_numbers() -> None:
    client = Client(decoder_id="host-1")
    async with client.running():
        await client.touch()
        await client.read(NOTHING)
    assert client.announced[0] is not None
    assert client.announced[0].code == "decoder_starting"
    assert client.announced[-1] is None
    for path, shift in (("decoded", 0), ("decoded/summary", 0), ("contacts", 1000)):
        found = [(origin, message.seq) for origin, topic, message in client.messages if topic == path]
        assert len(found) >= 3
        assert all(seq == origin + shift for origin, seq in found)
    (onset,) = client.events
    assert (onset.event, onset.contact.id, onset.decoder_id) == ("onset", 1, "host-1")
    assert [contact.id for contact in client.on("contacts")[-2].contacts] == [1]


async def test_a_site_that_fails_is_announced_until_a_load_shows_that_it_is_sound() -> None:
    client, failing = Client(), pressed(0)
    failing[:, 66] = 0.0  # under the contact
    async with client.running(), asyncio.timeout(120):
        for values, suspects, code in ((failing, (166,), "sensor_suspect"), (pressed(0), (), None)):
            while client.supervisor.suspects != suspects or not client.events:
                await client.read(values)
            assert getattr(client.announced[-1], "code", None) == code


async def test_a_contact_that_is_no_ball_is_contradicted_and_then_named() -> None:
    turns, total = np.arange(24) * np.pi / 12.0, np.zeros((3, SITES))
    for angle in (np.arange(12) + 0.5) * np.pi / 24.0:  # point loads on rings, as under a flat punch of 1.2 mm
        for turn in turns:
            place = 1.2e-3 * np.sin(angle) * np.array([np.cos(turn), np.sin(turn)])
            fields = hertz_fields(SITES_M - place, 1e-3, [0.0], E, NU)[0, 2]
            total += np.sin(angle) * fields * [[1.5 / E], [1.0], [1.0]]
    punch = total / (24.0 * np.sum(np.sin((np.arange(12) + 0.5) * np.pi / 24.0)))
    client, rng = Client(), np.random.default_rng(1)
    async with client.running(), asyncio.timeout(120):
        while not client.announced or getattr(client.announced[-1], "code", None) != "fit_contradicted":
            await client.read(punch + NOISE * rng.standard_normal(punch.shape))
        while client.on("contacts")[-1].contacts[0].shape != "punch" or client.announced[-1] is not None:
            await client.read(punch + NOISE * rng.standard_normal(punch.shape))
    (contact,) = client.on("contacts")[-1].contacts
    assert (contact.status, contact.reason_code) == ("ok", None)
    assert contact.force_newton == pytest.approx([0.0, 0.0, 1.0], abs=5.0 * max(contact.noise_newton))


async def test_frames_wait_in_order_and_of_those_that_wait_too_long_the_newest_is_decoded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(surface_decoding, "WAIT_MAX_NS", 0)
    client = Client()
    async with client.running():
        for _ in range(5):
            client.offer(NOTHING)
        await client.read(NOTHING)
        assert client.supervisor.skipped["not_ready"] >= 5
        assert client.supervisor.skipped["newer_frame"] == 0
        for _ in range(30):
            client.offer(NOTHING)
        assert client.supervisor.waiting == 2
        assert client.is_exact
        await until(lambda: client.supervisor.waiting == 0)
        assert client.supervisor.skipped["newer_frame"] == 28
        monkeypatch.setattr(surface_decoding, "WAIT_MAX_NS", 10**12)
        first = client.offered
        for _ in range(3):
            client.offer(NOTHING)
        assert client.supervisor.waiting == 3
        await until(lambda: client.on("contacts")[-1].seq == 1000 + client.offered - 1)
    assert [message.seq for message in client.on("decoded")][-3:] == list(range(first, first + 3))
    for path in ("decoded", "decoded/summary", "contacts"):
        for before, after in pairwise(client.on(path)):
            assert 3 * (after.seq - before.seq - 1) == after.lost.skipped_late - before.lost.skipped_late


async def test_an_interruption_releases_contacts_for_its_reason_and_only_then() -> None:
    client = Client()
    async with client.running():
        await client.read(NOTHING)
        client.supervisor.interrupt(Reason(ReasonCode.NO_SIGNALS, "nothing is there yet"))
        await client.touch()
        client.supervisor.interrupt(Reason(ReasonCode.NO_FRAMES, "unplugged"))
        client.supervisor.interrupt(Reason(ReasonCode.NO_FRAMES, "unplugged"))
        await until(lambda: len(client.events) == 2)
        await client.touch()
    client.supervisor.interrupt(Reason(ReasonCode.STOPPED, "after the end of the process"))
    assert [(event.event, event.reason_code) for event in client.events] == [
        ("onset", None),
        ("release", "no_frames"),
        ("onset", None),
        ("release", "stopped"),
    ]
    first, release, second, _ = client.events
    assert first.contact.id == release.contact.id < second.contact.id
    assert [message.contacts for message in client.on("contacts") if message.seq == 5000] == [(), ()]


async def test_a_process_that_is_killed_is_restarted_and_its_contacts_end() -> None:
    client = Client()
    async with client.running():
        await client.touch()
        pid = client.supervisor.info().pid
        assert pid is not None
        assert (psutil.Process(pid).name(), psutil.Process(pid).cmdline()[-3]) == ("resonatord-dec", "hand")
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # for the daemon
            os.kill(pid, number)
        await client.read()
        assert client.supervisor.restarts == {}
        before = client.on("contacts")[-1].contacts[0]
        os.kill(pid, signal.SIGKILL)
        await until(lambda: len(client.events) == 2)
        assert client.announced[-1] == ("decoder_crashed", "decoder crashed (by SIGKILL) and is restarted")
        await client.touch()
        assert client.supervisor.restarts == {"crashed": 1}
        assert client.supervisor.info().pid not in (None, pid)
        assert client.is_exact
    assert client.announced[-1] is None
    onset, release, again = client.events
    assert [event.event for event in client.events] == ["onset", "release", "onset"]
    assert release.reason == "the decoder crashed"
    assert release.contact.id == onset.contact.id < again.contact.id
    assert release.contact.since_t_ns == onset.contact.since_t_ns
    assert release.contact.force_newton == before.force_newton
    (ended,) = [message for message in client.on("contacts") if message.seq == 5000]
    assert (ended.status, ended.reason_code, ended.contacts) == ("no_signal", ReasonCode.DECODER_CRASHED, ())


async def test_a_process_that_stops_is_killed_and_restarted(monkeypatch: pytest.MonkeyPatch) -> None:
    client = Client()
    async with client.running():
        await client.touch()
        pid = client.supervisor.info().pid
        assert pid is not None
        monkeypatch.setattr(supervisor, "HUNG_S", 0.2)
        os.kill(pid, signal.SIGSTOP)
        for _ in range(3):
            client.offer()
        assert client.supervisor.waiting == 3
        await until(lambda: len(client.events) == 2)
        assert not psutil.pid_exists(pid)
        monkeypatch.undo()
        await client.touch()
        assert client.supervisor.restarts == {"hung": 1}
        assert client.supervisor.skipped["decoder_ended"] >= 3
        assert client.supervisor.skipped["newer_frame"] == 0
    assert [event.reason for event in client.events] == [None, "the decoder hung", None]


async def test_sites_that_cannot_be_decoded_are_announced_and_not_tried_again() -> None:
    twice = SKIN.site_positions_m.copy()
    twice[1] = twice[0]
    client = Client(skin=Skin(SKIN.half_space, twice, 1e-3))
    async with client.running() as running:
        client.offer(NOTHING)
        client.offer(NOTHING)
        await asyncio.wait_for(running, 30)
        client.offer(NOTHING)
        assert client.is_exact
        assert client.supervisor.restarts == {}
        assert client.supervisor.skipped == {"not_ready": 1, "undecodable": 2}
    assert client.announced[-1] is not None
    assert client.announced[-1].code == "undecodable"


async def test_frames_whose_noise_is_not_known_are_counted_apart() -> None:
    client = Client()
    async with client.running():
        client.supervisor.offer(0, frame(0, noise_std=np.full((3, SITES), np.nan)))
        client.offered = 1
        await until(lambda: client.supervisor.skipped["no_noise"] == 1)
        await client.read(NOTHING)


DAEMON = """
import asyncio, sys
sys.path[:0] = {paths!r}
from surface_bench import Client, NOTHING

async def main():
    client = Client()
    async with client.running():
        await client.read(NOTHING)
        print(client.supervisor.info().pid, flush=True)
        await asyncio.sleep(600)

asyncio.run(main())
"""


async def test_the_process_ends_with_a_daemon_that_is_killed() -> None:
    """Also where it is stopped: it never sees that the socket is closed."""
    program = DAEMON.format(paths=sys.path)
    daemon = await asyncio.create_subprocess_exec(sys.executable, "-c", program, stdout=asyncio.subprocess.PIPE)
    assert daemon.stdout is not None
    pid = int(await asyncio.wait_for(daemon.stdout.readline(), 120))
    os.kill(pid, signal.SIGSTOP)
    daemon.kill()
    await daemon.wait()
    await until(lambda: not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE)
