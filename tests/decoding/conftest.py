"""Decoders in the place of the real one."""

import functools
from collections.abc import Callable, Iterator

import pytest
from streaming_bench import SubstituteDecoder

from resonator_daemon.decoding import streaming
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
        monkeypatch.setattr(streaming, "SkinDecoder", decoder)
        monkeypatch.setattr(streaming, "cached", lambda _, build: build())

    return put
