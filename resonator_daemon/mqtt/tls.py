"""TLS context of a connection to a broker, made from its files for each connection."""

import contextlib
import selectors
import ssl
from typing import Final

from resonator_daemon.board.config.broker_files import load_certificates
from resonator_daemon.board.config.mqtt import Mqtt

LEAST_VERSION: Final = ssl.TLSVersion.TLSv1_2
ALERT_S: Final = 0.5


class _AlertAwaitingSocket(ssl.SSLSocket):
    def do_handshake(self, block: bool = False) -> None:
        try:
            super().do_handshake(block)
            if self.version() == "TLSv1.3":
                self._await_alert()
        except OSError:
            self.close()  # the MQTT library leaves that to the collector of garbage
            raise

    def _await_alert(self) -> None:
        """Wait for the broker's first data after the handshake: a refusal of the client's certificate, or a ticket.

        In TLS 1.3 a client is done before its certificate has been looked at. What it writes until then may have the
        connection reset, and the reason lost. Brokers that give no tickets cost half a second.
        """
        with selectors.DefaultSelector() as selector:
            selector.register(self, selectors.EVENT_READ)
            selector.select(ALERT_S)
        timeout_s = self.gettimeout()
        self.setblocking(False)
        with contextlib.suppress(ssl.SSLWantReadError, ConnectionResetError):
            self.recv(1)  # takes in tickets, and raises what is an alert
        self.settimeout(timeout_s)


def make_tls(broker: Mqtt) -> ssl.SSLContext:
    """Make the context for a connection, which checks the broker's certificate and its name.

    Raises
    ------
    UnusableFileError
        A file of the configuration cannot be used any more.
    """
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    tls.minimum_version = LEAST_VERSION
    tls.sslsocket_class = _AlertAwaitingSocket
    load_certificates(tls, *broker.certificates)
    return tls
