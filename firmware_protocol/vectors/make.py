"""Writes the vectors: `python -m firmware_protocol.vectors.make`, with a folder behind it elsewhere.

Nothing of the implementation is imported: the packets are put together here once more, and what a receiver makes of a
stream is written down, not computed.
"""

import json
import sys
from pathlib import Path

from firmware_protocol.vectors.message_cases import checks, messages
from firmware_protocol.vectors.session_cases import board_sessions
from firmware_protocol.vectors.stream_cases import streams

if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    made = {"checks": checks(), "streams": streams(), "messages": messages(), "board_sessions": board_sessions()}
    for name, cases in made.items():
        (folder / f"{name}.json").write_text(json.dumps(cases, indent=1, ensure_ascii=False) + "\n")
