"""`resonatord schema`: the AsyncAPI document of everything that is published and obeyed."""

import json
import sys

from resonator_daemon.publishing.asyncapi import document


def print_schema(*, as_json: bool) -> None:
    """Write the document to the standard output: on one line, or for people indented."""
    sys.stdout.write(json.dumps(document(), indent=None if as_json else 2, ensure_ascii=False) + "\n")
