"""Host names to addresses, within a bound: the C library's resolver may take half a minute, uninterruptible."""

import socket
import threading
from concurrent.futures import Future

Addresses = list[tuple[int, tuple[str | int | bytes, ...]]]  # of version 6 with the interface it belongs to

_under_way: dict[tuple[str, int], Future[Addresses]] = {}
_guard = threading.Lock()


def resolve_host(host: str, port: int, timeout_s: float) -> Addresses:
    """Return families and addresses; a look-up that took too long goes on, and its answer serves the next call.

    Raises
    ------
    OSError
        The host is not known; TimeoutError when the resolver does not answer in time.
    UnicodeError
        No host can have such a name.
    """
    with _guard:
        answer = _under_way.get((host, port))
        if answer is None:
            answer = Future()
            # No pool: those of concurrent.futures are waited for when the process ends.
            threading.Thread(target=_resolve, args=(host, port, answer), name="look-up", daemon=True).start()
            _under_way[host, port] = answer
    try:
        return answer.result(timeout_s)
    except TimeoutError:
        if answer.done():
            raise
        raise TimeoutError(f"its name was not found within {timeout_s:g} s") from None
    finally:
        if answer.done():
            with _guard:
                _under_way.pop((host, port), None)


def _resolve(host: str, port: int, answer: Future[Addresses]) -> None:
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        answer.set_result([(family, address) for family, _, _, _, address in found])
    except Exception as error:  # noqa: BLE001 - raised where the answer is awaited, which would be for ever
        answer.set_exception(error)
