"""Recordings on the live page: played, paused and sought, whole and cut off."""

import gzip
import json
import shutil
from pathlib import Path

import psutil
from observer import until
from page_client import browser, served

from resonator_daemon.board.recording.reader import open_recording
from resonator_daemon.extensions.live_page.hub import Sources
from resonator_daemon.extensions.live_page.library import Library, Recorded
from resonator_daemon.extensions.live_page.player import Player
from resonator_daemon.extensions.live_page.protocol import Outgoing

CORPUS = Path(__file__).parents[2] / "corpus"
WHOLE, CUT_OFF = CORPUS / "touches" / "recording.mcap", CORPUS / "cut-off" / "recording.mcap"


def duration_s(path: Path) -> float:
    with open_recording(str(path)) as recording:
        times_ns = [entry.now.monotonic_ns for entry in recording.entries()]
    return (times_ns[-1] - times_ns[0]) * 1e-9


def expected_events(path: Path) -> list[str]:
    """Return the kinds of events that the replay of a case gives."""
    messages = map(json.loads, gzip.decompress(path.with_name("expected.jsonl.gz").read_bytes()).splitlines())
    return [it["payload"]["event"] for it in messages if it.get("topic") == "contacts/event"]


async def test_two_recordings_play_and_the_one_that_is_cut_off_reports_it() -> None:
    async with served(Sources(None, [WHOLE, CUT_OFF])) as url, browser(url) as tab:
        hello = await tab.key("hello", lambda it: all(source["plate"] for source in it["sources"]))
        whole, cut_off = hello["sources"]
        assert (whole["source"], cut_off["source"]) == ("a", "b")
        assert abs(whole["duration_s"] - duration_s(WHOLE)) < 1e-6
        ended = await tab.key("position", lambda it: it["source"] == "b" and it["ended"])
        assert ended["truncated"]
        assert abs(ended["t_s"] - duration_s(CUT_OFF)) < 0.1
        address = f"a/{whole['plate']}"
        await tab.key("position", lambda it: it["source"] == "a" and it["decoded_s"] >= whole["duration_s"] - 0.1)
        assert (await tab.watch(whole["plate"], "forces", source="a"))["ok"]
        assert (await tab.ask({"id": 1, "play": {"source": "a", "playing": False, "speed": 20.0}}))["ok"]
        assert (await tab.ask({"id": 2, "seek": {"source": "a", "t_s": 0.0}}))["ok"]
        paused = await tab.key("position", lambda it: it["source"] == "a" and it["t_s"] == 0.0)
        assert (paused["playing"], paused["ended"], paused["speed"]) == (False, False, 20.0)
        await tab.ask({"id": 3, "play": {"source": "a", "playing": True}})
        for kind in expected_events(WHOLE):
            assert json.loads(await tab.frame(f"{address}/contacts/event"))["event"] == kind
        end = await tab.key("position", lambda it: it["source"] == "a" and it["ended"])
        assert (end["playing"], end["truncated"]) == (False, None)
        await tab.ask({"id": 4, "seek": {"source": "a", "t_s": 1e9}})  # beyond the end: at the end
        sent = json.loads(await tab.frame(f"{address}/forces"))
        assert sent["name"] == whole["plate"]
        assert await tab.refusal({"command": {"plate": whole["plate"], "verb": "tare"}}) == "read_only"


async def test_recordings_of_a_directory_are_opened_compared_and_closed(tmp_path: Path) -> None:
    shutil.copy(WHOLE, tmp_path / "whole.mcap")
    shutil.copy(CUT_OFF, tmp_path / "cut-off.mcap")
    (tmp_path / "text.mcap").write_text("no recording")
    (tmp_path / "bare.mcap").write_bytes(WHOLE.read_bytes()[:8])
    (tmp_path / "link.mcap").symlink_to(WHOLE)
    async with served(Sources(None, directory=tmp_path)) as url, browser(url) as tab, browser(url) as other:
        hello = await tab.key("hello")
        assert (hello["sources"], hello["directory"]) == ([], tmp_path.name)
        listed = (await tab.ask({"id": 1, "recordings": {}}))["recordings"]
        assert {it["name"] for it in listed} == {"whole.mcap", "cut-off.mcap", "bare.mcap"}
        for name in (f"../{tmp_path.name}/whole.mcap", str(WHOLE), "link.mcap", "gone.mcap", "text.mcap"):
            assert await tab.refusal({"open": {"names": [name]}}) == "unknown_recording"
        assert (await tab.ask({"id": 2, "open": {"names": ["whole.mcap"]}}))["ok"]
        await tab.key("position", lambda it: it["decoded_s"] > 1.0)
        assert (await tab.ask({"id": 3, "open": {"names": ["whole.mcap", "cut-off.mcap"]}}))["ok"]
        await tab.key("position", lambda it: it["source"] == "b" and it["t_s"] > 0.1)
        for source in "ab":  # the first, which is decoded, has waited for the second
            await tab.socket.send_json({"play": {"source": source, "playing": False}})
        one = await tab.key("position", lambda it: it["source"] == "a" and not it["playing"])
        two = await tab.key("position", lambda it: it["source"] == "b" and not it["playing"])
        assert abs(one["t_s"] - two["t_s"]) < 0.1
        assert (await tab.ask({"id": 4, "open": {"names": ["bare.mcap"]}}))["ok"]
        (failed,) = (await tab.key("hello", lambda it: it["sources"] and it["sources"][0]["failure"]))["sources"]
        assert "no recording" in failed["failure"]
        assert str(tmp_path) not in failed["failure"]
        assert await other.refusal({"play": {"source": "a", "playing": True}}) == "unknown_source"


async def test_a_process_that_decodes_may_be_killed_and_ends_with_the_page() -> None:
    others = set(psutil.Process().children())  # of earlier tests in this process

    def decoding() -> list[psutil.Process]:
        return [child for child in psutil.Process().children() if child not in others]

    library = Library(None, lambda: None)
    (killed,) = library.exchange([], [WHOLE])
    await until(lambda: bool(decoding()))
    decoding()[0].kill()
    await until(lambda: killed.complete)
    assert killed.failure or killed.truncated
    library.exchange([], [CUT_OFF])
    await until(lambda: bool(decoding()))
    library.exchange([WHOLE, CUT_OFF], [])
    await library.close()
    assert not decoding()


async def test_messages_of_the_first_moment_are_sent_once_they_are_decoded() -> None:
    recorded, outgoing = Recorded(WHOLE, lambda: None), Outgoing()
    player = Player("a", recorded, outgoing, lambda *_: True)
    for path in ("state/link", "info"):  # none is decoded at the first turn; the second has the time of the first
        player.advance(0)
        recorded.tracks[path].times_ns.append(0)
        recorded.tracks[path].places.append((0, 0))
    player.advance(0)
    outgoing.put_newest("stream", "last")
    assert [await outgoing.get() for _ in range(3)] == [b"\x0da//state/link", b"\x07a//info", "last"]
