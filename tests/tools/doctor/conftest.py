"""Shorter looks than a person's, where what is found does not depend on it."""

import pytest

from resonator_daemon.board.session import probe as port_inquiry
from resonator_daemon.tools.doctor import broker_checks


@pytest.fixture(autouse=True)
def _short_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port_inquiry, "PING_S", 0.01)
    monkeypatch.setattr(broker_checks, "TURNS", 8)
