"""Client of the status sockets of the daemons on this computer."""

import asyncio
import grp
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from resonator_daemon.base.errors import meaning_of
from resonator_daemon.base.host.files import runtime_directories
from resonator_daemon.daemon.monitoring.status_server import SOCKET_NAME

ANSWER_S: Final = 2.0
_BYTES_MAX: Final = 4 * 1024**2


@dataclass(frozen=True)
class Answer:
    """What came of asking at one socket: a status as JSON, or why there is none."""

    socket: Path
    status: dict[str, Any] | None
    problem: str | None

    @property
    def names(self) -> set[str]:
        """The names by which people may mean this daemon."""
        name = (self.status or {}).get("name")
        return {self.socket.parent.name, name} if isinstance(name, str) else {self.socket.parent.name}


async def ask_all(wanted: str | None) -> list[Answer]:
    """Ask all daemons at once; return those that run, in the order of their sockets.

    `wanted` limits them to those of one name, or of a configuration file, which ends in .toml.
    """
    names = {wanted, Path(wanted).stem} if wanted is not None and wanted.endswith(".toml") else {wanted}
    sockets = {path for directory in runtime_directories() for path in directory.glob(f"*/{SOCKET_NAME}")}
    answers = await asyncio.gather(*map(_ask, sorted(sockets)))
    return [answer for answer in answers if answer is not None and (wanted is None or names & answer.names)]


async def _ask(path: Path) -> Answer | None:
    """Return None if no process listens: a daemon that was killed leaves its socket."""
    try:
        async with asyncio.timeout(ANSWER_S):
            reader, writer = await asyncio.open_unix_connection(path)
            try:
                answer = b""
                while len(answer) < _BYTES_MAX and (part := await reader.read(65_536)):
                    answer += part
            finally:
                writer.close()
    except (ConnectionRefusedError, FileNotFoundError):
        return None
    except TimeoutError:
        return Answer(path, None, f"runs and gives no answer within {ANSWER_S:g} s: is it stopped, or overloaded?")
    except PermissionError:
        return Answer(path, None, f"this user may not access it; {_who_may(path)}")
    except OSError as error:
        return Answer(path, None, meaning_of(error))
    try:
        status = json.loads(answer)
    except (ValueError, RecursionError):
        status = None
    return Answer(path, status, None) if isinstance(status, dict) else Answer(path, None, "its answer is no status")


def _who_may(path: Path) -> str:
    try:
        group_id = path.stat().st_gid
        group = grp.getgrgid(group_id).gr_name
    except KeyError:
        group = str(group_id)
    except OSError:
        return "retry as the user that the daemon runs as"
    return f"users of the group {group} may: `sudo usermod -aG {group} $USER`, then log in again"
