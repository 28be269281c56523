"""Decoders in the place of the real one."""

import functools
import queue
import threading
from collections.abc import Callable, Iterator

import pytest
from stage_bench import HeldDecoder, SubstituteDecoder

from resonator_daemon.decoding import stage as stage_module
from resonator_daemon.decoding.fitting import contact_model


@pytest.fixture(scope="session", autouse=True)
def _tables_are_computed_once() -> Iterator[None]:
    """Models of sites that span the same share one table: up to a second each, and only ever read."""
    with pytest.MonkeyPatch.context() as patch:
        compute = contact_model._table

        @functools.cache
        def table(*numbers: object) -> contact_model.Floats:
            computed = compute(*numbers)  # type: ignore[arg-type]
            computed.flags.writeable = False
            return computed

        patch.setattr(contact_model, "_table", table)
        yield


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
