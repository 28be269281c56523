"""Decoder process, started by a daemon: `python -m resonator_daemon.measure.decoder_process NAME SOCKET MEMORY`.

Socket and memory are descriptors.
"""

import contextlib
import ctypes
import signal
import socket
import sys

from resonator_daemon.base.host.signals import signal_at_parent_death
from resonator_daemon.base.host.systemd import set_up_logging, tag_log

_PR_SET_NAME = 15  # linux/prctl.h


def main() -> None:
    """Decode until the daemon ends or closes the socket; ignore signals that address the daemon."""
    name, socket_fd, memory_fd = sys.argv[1:]
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    signal_at_parent_death(signal.SIGKILL)  # also ends a frame that never ends; else the closed socket does
    ctypes.CDLL(None).prctl(_PR_SET_NAME, b"resonatord-dec")  # 15 bytes at most
    set_up_logging()
    tag_log(name)
    connection = socket.socket(fileno=int(socket_fd))
    # Slow imports: signals are ignored by now.
    from resonator_daemon.measure.decoder_process.decoder_connection import DecoderConnection
    from resonator_daemon.measure.decoder_process.worker import work

    with connection, contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):  # the daemon has gone
        work(DecoderConnection(connection, int(memory_fd), is_daemon=False))


if __name__ == "__main__":
    main()
