"""Sends a command to a daemon and prints its answer: command.py HOST PORT NAME VERB [REQUEST].

REQUEST is a JSON object: command.py 127.0.0.1 1883 left-index set_window '{"window_ms": 20}'. The exit code is 0 if
the command was done.
"""

import asyncio
import json
import sys

import resonatord

if len(sys.argv) not in (5, 6):
    sys.exit(__doc__)
host, port, name, verb, request = [*sys.argv[1:], "{}"][:5]

try:
    answer = asyncio.run(resonatord.command(f"mqtt://{host}:{port}", name, verb, **json.loads(request)))
except resonatord.RefusedError as error:
    sys.exit(f"{error.code}: {error}")
except resonatord.UserError as error:
    sys.exit(str(error))
print(answer.model_dump_json())
