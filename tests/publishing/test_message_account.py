"""What is dropped is said: at once together, then once a minute, and never what is said elsewhere."""

import asyncio
import logging

import pytest
from mqtt_helpers import until

from resonator_daemon.publishing import message_account
from resonator_daemon.publishing.message_account import Account, Cause


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(message_account, "FIRST_LINE_S", 0.01)


async def test_drops_are_summed_up_in_one_line(caplog: pytest.LogCaptureFixture) -> None:
    account = Account()
    for _ in range(30):
        account.drop(Cause.QUEUE_FULL, "a/forces")
    account.drop(Cause.REFUSED, "a/info", 2)
    await until(lambda: bool(caplog.records))
    (said,) = caplog.messages
    assert said.startswith("messages dropped: 30 a/forces (queue_full), 2 a/info (refused); the broker's access rules")
    assert account.dropped == {"queue_full": 30, "refused": 2}
    account.close()


async def test_while_it_lasts_it_is_said_now_and_then_and_at_the_end(
    caplog: pytest.LogCaptureFixture,
) -> None:
    account = Account()
    account.drop(Cause.QUEUE_FULL, "t")
    await until(lambda: len(caplog.records) == 1)
    account.drop(Cause.QUEUE_FULL, "t", 5)
    for _ in range(10):
        await asyncio.sleep(0.005)
    assert len(caplog.records) == 1
    account.close()
    assert caplog.messages[1:] == ["messages dropped: 5 t (queue_full)"]


async def test_what_is_known_by_other_words_is_not_said(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    account = Account()
    for cause in (Cause.NO_CONNECTION, Cause.SUPERSEDED, Cause.TOO_LARGE, Cause.SPOOL_FAILED, Cause.CLOSED):
        account.drop(cause, "t")
    account.close()
    assert not caplog.records
