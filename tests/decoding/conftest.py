"""Decoders in the place of the real one."""

import queue
import threading
from collections.abc import Callable

import pytest
from stage_bench import HeldDecoder, SubstituteDecoder

from resonator_daemon.decoding import stage as stage_module


@pytest.fixture
def substitute(monkeypatch: pytest.MonkeyPatch) -> Callable[[type[SubstituteDecoder]], None]:
    """Put another decoder in the place of the real one, and keep none in files."""

    def put(decoder: type[SubstituteDecoder]) -> None:
        monkeypatch.setattr(stage_module, "SkinDecoder", decoder)
        monkeypatch.setattr(stage_module, "cached", lambda _, build: build())

    return put


@pytest.fixture
def held(substitute: Callable[[type[SubstituteDecoder]], None]) -> type[HeldDecoder]:
    """Substitute a decoder that waits."""
    HeldDecoder.entered, HeldDecoder.released, HeldDecoder.threads = queue.Queue(), threading.Semaphore(0), set()
    substitute(HeldDecoder)
    return HeldDecoder
