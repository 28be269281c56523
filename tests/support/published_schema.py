"""Messages of a daemon, its answers and the commands to it, judged by the schema that it publishes."""

import json
import re

from example_messages import as_rows
from jsonschema import Draft7Validator
from observer import Observer

HAND = "resonator/hand"
ALWAYS = {"state/daemon", "state/link", "state/sensor", "info", "schema", "health"}


def check_all(observer: Observer) -> set[str]:
    """Check each message by the document that the daemon has published; return the paths observer."""
    document = json.loads(observer.raw(f"{HAND}/schema")[0])
    components = document["components"]

    def validator_of(references: list[dict[str, str]]) -> tuple[Draft7Validator, str]:
        names = [reference["$ref"].rpartition("/")[2] for reference in references]
        (content_type,) = {components["messages"][name]["contentType"] for name in names}
        payloads = [components["messages"][name]["payload"] for name in names]
        return Draft7Validator({"oneOf": payloads, "components": components}), content_type

    validators = {}
    for channel in document["channels"].values():
        if channel["address"] is not None:
            path = channel["address"].removeprefix("{prefix}/{name}/")
            validators[re.sub("{.*?}", "[^/]+", path)] = validator_of(list(channel["messages"].values()))
    for name, operation in document["operations"].items():
        if "reply" in operation:
            answers = validator_of(operation["reply"]["messages"])
            validators[name.replace("cmd_", "rsp/") + "/[^/]+"] = answers
    paths = set()
    for message in observer.messages:
        path = message.topic.value.removeprefix(f"{HAND}/")
        validator, content_type = next(found for pattern, found in validators.items() if re.fullmatch(pattern, path))
        payload = bytes(message.payload)
        validator.validate(json.loads(payload) if content_type == "application/json" else as_rows(payload))
        paths.add(re.sub(r"^(rsp/\w+)/.*", r"\1/+", path))
    return paths
