"""The AsyncAPI 3 document of all topics, made from the models of their payloads: what `schema` and the shell show."""

import json
from functools import cache
from pathlib import Path
from typing import Any, Final

from resonator_daemon.board.config.tables import DECODER
from resonator_daemon.mqtt.json_schemas import REF, schemas_of_cbor, schemas_of_json, schemas_of_requests
from resonator_daemon.mqtt.message_examples import ANSWER_EXAMPLES, ARRAY_EXAMPLES, EXAMPLES, REQUEST_EXAMPLES
from resonator_daemon.mqtt.payloads import WITH_ARRAYS, Message
from resonator_daemon.mqtt.topics import (
    CBOR,
    DECODER_HEALTH,
    DECODER_STATE,
    JSON,
    SCHEMA_PATH,
    SCHEMA_VERSION,
    TOPICS,
    Topic,
)
from resonator_daemon.mqtt.verbs import UNKNOWN, VERBS, Refusal, Verb

Object = dict[str, Any]

_BINDING: Final[Object] = {"bindingVersion": "0.2.0"}
_COMMAND: Final[Object] = {"qos": 1, "retain": False}
_PLATE: Final = "{prefix}/{name}/"
_DECODER: Final = f"{{prefix}}/{DECODER}/{{id}}/"
_OF_DECODERS: Final[tuple[Topic[Any], ...]] = (DECODER_STATE, DECODER_HEALTH)
_DOCUMENT: Final = "AsyncApiDocument"
_REPLY: Final = "reply"
_CORRELATION: Final = "command"
# What does not depend on topics and commands: description, parameters of addresses, schemas of MQTT's properties.
_PARTS: Final[Object] = json.loads(
    Path(__file__).with_suffix(".json").read_text(encoding="utf-8").replace("SCHEMA_VERSION", SCHEMA_VERSION)
)


@cache
def encoded() -> bytes:
    """Return the document as published, JSON without white space."""
    return json.dumps(document(), separators=(",", ":"), allow_nan=False, ensure_ascii=False).encode()


def document() -> Object:
    """Return the document, the same for each daemon of this version; AsyncAPI 3.0.0."""
    document = _Document()
    for base, topics in ((_PLATE, TOPICS.values()), (_DECODER, _OF_DECODERS)):
        for topic in topics:
            document.add_topic(base, topic.path, topic, topic.payload.__doc__)
            if topic.slow_hz is not None:
                copied = f"The messages of `{topic.path}`, at most {topic.slow_hz} a second; for display."
                document.add_topic(base, topic.slow_path, topic, copied)
    about = "This document, made from the models of the payloads."
    delivery = {"qos": 1, "retain": True}
    document.add("send", f"publish_{SCHEMA_PATH}", SCHEMA_PATH, _PLATE + SCHEMA_PATH, about, delivery, _DOCUMENT)
    answers = (*(verb.answer.__name__ for verb in VERBS.values()), Refusal.__name__)
    document.channels[_REPLY] = _channel(None, "The response topic that a command names.", *answers)
    for verb in VERBS.values():
        document.add_verb(verb)
    about = "The refusal of an unknown command, with the `verb` `unknown` and the code `unknown_verb`."
    summary = "Refuses an unknown command that has no response topic."
    document.add_answers(UNKNOWN, about, summary, Refusal.__name__)
    return {
        "asyncapi": "3.0.0",
        "info": _PARTS["info"],
        "defaultContentType": JSON,
        "channels": document.channels,
        "operations": document.operations,
        "components": {"messages": _messages(), "schemas": _schemas(), "correlationIds": _PARTS["correlationIds"]},
    }


class _Document:
    """Channels and operations, the latter with the messages of the former."""

    def __init__(self) -> None:
        self.channels: Object = {}
        self.operations: Object = {}

    def add(
        self, action: str, name: str, key: str, address: str, about: str | None, delivery: Object, *messages: str
    ) -> Object:
        """Add a channel and the operation on it; return the latter, to be completed."""
        self.channels[key] = _channel(address, about, *messages)
        operation = self.operations[name] = {
            "action": action,
            "channel": _channel_ref(key),
            "messages": [_message_of(key, message) for message in messages],
            "bindings": {"mqtt": _BINDING | delivery},
        }
        return operation

    def add_topic(self, base: str, path: str, topic: Topic[Any], about: str | None) -> None:
        key = ("" if base == _PLATE else f"{DECODER}_") + path.replace("/", "_")
        delivery: Object = {"qos": topic.qos, "retain": topic.retained}
        if topic.expiry_s is not None:
            delivery["messageExpiryInterval"] = topic.expiry_s
        self.add("send", f"publish_{key}", key, base + path, about, delivery, topic.payload.__name__)

    def add_verb(self, verb: Verb) -> None:
        command, answers = f"cmd_{verb.name}", (verb.answer.__name__, Refusal.__name__)
        address, about = f"{_PLATE}cmd/{verb.name}", f"A command: {verb.summary}."
        self.add("receive", command, command, address, about, _COMMAND, verb.request.__name__).update(
            {
                "summary": f"{verb.summary[0].upper()}{verb.summary[1:]}.",
                "description": "Answered on the response topic, where the command names one (MQTT 5), else on "
                f"`rsp_{verb.name}`.",
                "reply": {
                    "address": {
                        "location": "$message.header#/response_topic",
                        "description": "the property Response Topic of MQTT 5",
                    },
                    "channel": _channel_ref(_REPLY),
                    "messages": [_message_of(_REPLY, answer) for answer in answers],
                },
                "x-changes": verb.changes,
            }
        )
        about = "Its answer, where no response topic was named."
        summary = f"Answers `{verb.name}`, where the command names no response topic."
        self.add_answers(verb.name, about, summary, *answers)

    def add_answers(self, verb: str, about: str, summary: str, *answers: str) -> None:
        response = f"rsp_{verb}"
        self.add("send", response, response, f"{_PLATE}rsp/{verb}", about, _COMMAND, *answers)["summary"] = summary


def _channel(address: str | None, about: str | None, *messages: str) -> Object:
    channel: Object = {
        "address": address,
        "description": about,
        "messages": {message: {"$ref": f"#/components/messages/{message}"} for message in messages},
    }
    if address is not None:
        channel["parameters"] = {
            name: about for name, about in _PARTS["parameters"].items() if f"{{{name}}}" in address
        }
    return channel


def _channel_ref(channel: str) -> Object:
    return {"$ref": f"#/channels/{channel}"}


def _message_of(channel: str, message: str) -> Object:
    return {"$ref": f"#/channels/{channel}/messages/{message}"}


def _published() -> list[type[Message]]:
    return list(dict.fromkeys(topic.payload for topic in (*TOPICS.values(), *_OF_DECODERS)))


def _messages() -> Object:
    messages = {
        kind.__name__: _versioned(kind.__name__, CBOR if kind in WITH_ARRAYS else JSON) for kind in _published()
    }
    messages[_DOCUMENT] = _versioned(_DOCUMENT, JSON)
    for request, example in REQUEST_EXAMPLES.items():
        messages[request] = _of_command(request, "RequestProperties", example)
    for answer, example in ANSWER_EXAMPLES.items():
        messages[answer] = _of_command(answer, "AnswerProperties", example) | {"bindings": {"mqtt": _format(JSON)}}
    return messages


def _versioned(name: str, content_type: str) -> Object:
    message = _message(name, content_type) | {
        "bindings": {"mqtt": _format(content_type)},
        "headers": {"type": "object", "properties": {"schema_version": _PARTS["version"]}},
    }
    if example := EXAMPLES.get(name) or ARRAY_EXAMPLES.get(name):
        message["examples"] = [{"payload": example}]
    return message


def _of_command(name: str, properties: str, example: Object) -> Object:
    return _message(name, JSON) | {
        "correlationId": {"$ref": f"#/components/correlationIds/{_CORRELATION}"},
        "headers": {"$ref": REF.format(model=properties)},
        "examples": [{"payload": example}],
    }


def _format(content_type: str) -> Object:
    return _BINDING | {"contentType": content_type, "payloadFormatIndicator": int(content_type == JSON)}


def _message(name: str, content_type: str) -> Object:
    return {"name": name, "contentType": content_type, "payload": {"$ref": REF.format(model=name)}}


def _schemas() -> Object:
    verbs = VERBS.values()
    in_json = [kind for kind in _published() if kind not in WITH_ARRAYS]
    return {
        **schemas_of_json([*in_json, *(verb.answer for verb in verbs), Refusal]),
        **schemas_of_cbor(WITH_ARRAYS),
        **schemas_of_requests(verb.request for verb in verbs),
        **_PARTS["schemas"],
    }
