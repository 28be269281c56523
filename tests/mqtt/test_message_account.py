"""What is dropped is said: at once together, then once a minute, and never what is said elsewhere."""

import asyncio

import pytest
from mqtt_helpers import until

from resonator_daemon.mqtt import message_account
from resonator_daemon.mqtt.message_account import Account, Cause


async def test_drops_are_summed_up_in_one_line(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(message_account, "FIRST_LINE_S", 0.01)
    account = Account()
    for _ in range(30):
        account.drop(Cause.QUEUE_FULL, "a/forces")
    account.drop(Cause.REFUSED, "a/info", 2)
    await until(lambda: bool(caplog.records))
    assert all(part in caplog.messages[0] for part in ("30 a/forces (queue_full)", "2 a/info (refused)"))
    assert account.dropped == {"queue_full": 30, "refused": 2}
    account.drop(Cause.QUEUE_FULL, "a/forces", 5)
    await asyncio.sleep(0.03)
    assert len(caplog.records) == 1  # the next line comes a minute later
    account.close()
    assert "5 a/forces (queue_full)" in caplog.messages[1]
