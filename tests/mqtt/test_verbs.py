"""The register of commands is whole, and its requests take what they say and nothing more."""

from typing import Any

import jsonschema
import pytest
from pydantic import ValidationError

from resonator_daemon.mqtt.verbs import VERBS, Refusal

EXAMPLES: dict[str, list[dict[str, Any]]] = {
    "ping": [{}, {"id": None}, *({"id": id_} for id_ in ("a", "é" * 64))],
    "events": [{}, {"after_seq": -1}, {"after_seq": 2**53 - 1, "daemon_boot_id": "9f3c52d0"}],
    "tare": [{}],
    "start_recording": [{}, {"label": "drop-test_3"}],
    "stop_recording": [{}],
    "mark": [{"text": "Finger über Stelle 7"}],
    "set_window": [{"window_ms": 20}, {"step_ms": 5}, {"window_ms": 10.0, "step_ms": 2.5}],
    "identify": [{}],
}
REFUSED: list[tuple[str, dict[str, Any]]] = [
    *((verb, {**examples[0], "more": 1}) for verb, examples in EXAMPLES.items()),
    *(("ping", {"id": id_}) for id_ in (7, 1.0, True, "", "a" * 65, "a\n", "\ud800", [], {})),
    *(("events", {"after_seq": seq}) for seq in (-2, 2**53, 1.5, "1", True, None)),
    *(("events", {"daemon_boot_id": boot_id}) for boot_id in ("", "a" * 65, 7)),
    *(("start_recording", {"label": label}) for label in ("", "a/b", "..", "a b", "é", "a\n", "a" * 65, 7, ["a"])),
    *(("mark", {"text": text}) for text in ("", "a\nb", "\x1b[2J", "\u202e", "\ud800", "x" * 201, 7, None)),
    ("mark", {}),
    *(("set_window", {"window_ms": ms}) for ms in (0, -1, 1001, float("nan"), "10", True, 10**400)),
    ("set_window", {"window_ms": 10, "step_ms": 0}),
]


@pytest.mark.parametrize(("verb", "request_"), [(verb, each) for verb, some in EXAMPLES.items() for each in some])
def test_requests_are_taken_and_fit_their_schema(verb: str, request_: dict[str, Any]) -> None:
    assert VERBS[verb].request.model_validate(request_)
    jsonschema.validate(request_, VERBS[verb].request.model_json_schema())


@pytest.mark.parametrize(("verb", "request_"), REFUSED)
def test_all_else_is_refused(verb: str, request_: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        VERBS[verb].request.model_validate(request_)


def test_each_verb_answers_with_its_name() -> None:
    assert EXAMPLES.keys() == VERBS.keys()
    for name, verb in VERBS.items():
        assert verb.name == name
        assert verb.answer.model_fields["verb"].default == name
        assert [*verb.answer.model_fields][:3] == ["verb", "ok", "id"]
    assert [*Refusal.model_fields] == ["verb", "ok", "id", "error"]
