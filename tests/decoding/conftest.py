"""Decoders in the place of the real one."""

from collections.abc import Callable

import pytest
from streaming_bench import SubstituteDecoder

from resonator_daemon.decoding import streaming


@pytest.fixture
def substitute(monkeypatch: pytest.MonkeyPatch) -> Callable[[type[SubstituteDecoder]], None]:
    """Put another decoder in the place of the real one, and keep none in files."""

    def put(decoder: type[SubstituteDecoder]) -> None:
        monkeypatch.setattr(streaming, "SkinDecoder", decoder)
        monkeypatch.setattr(streaming, "cached", lambda _, build: build())

    return put
