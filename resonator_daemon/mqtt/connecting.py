"""Opening of a connection to a broker: TLS, and errors, each with a sentence that names the key to check."""

import contextlib
import selectors
import socket
import ssl
from typing import Final

from paho.mqtt.enums import MQTTProtocolVersion

from resonator_daemon.base.errors import meaning_of, reason_of
from resonator_daemon.board.config.broker_files import UnusableFileError, load_certificates
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


UNSUPPORTED_VERSION: Final = 132
UNSPECIFIED: Final = 128  # the library's code for a connection that ended without a DISCONNECT packet

_PROTOCOL_ERROR: Final = 130  # the library's word for bytes that are not MQTT, and for a 3.1.1 broker's "no 3.1.1"
_REFUSED_CLIENTS: Final = (134, 135, 138)  # bad name or password, not authorized, banned
_NEITHER_VERSION: Final = "it supports neither MQTT 5 nor 3.1.1"


class BrokerError(Exception):
    """There is no connection to the broker, or no longer; `code` is MQTT's reason code if the broker sent one."""

    def __init__(self, message: str, *, code: int | None = None) -> None:
        super().__init__(message)
        self.code = code


class RefusalError(BrokerError):
    """The user has to change something at either end: frequent attempts would only fill the broker's log."""


class NoAnswerError(BrokerError):
    """The other end accepted the connection and closed it without an answer."""


class SilentError(BrokerError):
    """The other end accepts connections and does not answer."""

    def __init__(self, broker: Mqtt) -> None:
        super().__init__(f"it accepts connections and does not answer as an MQTT broker; see {broker.named_by}")


def of_opening(error: OSError, broker: Mqtt) -> BrokerError:
    """Return why the connection could not be opened, TLS included."""
    match error:
        case UnusableFileError():
            return BrokerError(str(error))
        case ssl.SSLCertVerificationError():
            ours = f"see mqtt.ca_file, {broker.named_by} and this computer's clock"
            return RefusalError(f"its certificate is not accepted ({error.verify_message}); {ours}")
        case ssl.SSLError(reason=str(reason)) if "_ALERT_" in reason:
            alert = reason.partition("_ALERT_")[2].replace("_", " ").lower()
            return RefusalError(f"it refuses the TLS connection ({alert}); see mqtt.certificate_file")
        case TimeoutError() if "handshake" not in str(error):
            return BrokerError(reason_of(error))
        case ssl.SSLError() | ConnectionResetError() | TimeoutError():
            plain = f"if the port is for plain MQTT, {broker.named_by} is mqtt://"
            return BrokerError(f"no TLS connection ({reason_of(error)}); {plain}")
        case socket.gaierror():
            return BrokerError(f"no host of this name ({meaning_of(error)}); see {broker.named_by}")
        case _:
            return BrokerError(reason_of(error))


def of_silent_end(reason_code: int, version: MQTTProtocolVersion, broker: Mqtt) -> BrokerError:
    """Return why the broker ended a connection that it had not accepted nor refused by an MQTT packet."""
    if reason_code == _PROTOCOL_ERROR and version is MQTTProtocolVersion.MQTTv311:
        return RefusalError(_NEITHER_VERSION)
    other = f"not for TLS, {broker.named_by} is mqtt://" if broker.tls else f"for TLS, {broker.named_by} is mqtts://"
    return NoAnswerError(f"it ended the connection without an answer; if the port is {other}")


def of_answer(error: Exception, broker: Mqtt) -> Exception:
    """Return a refusal if the broker's answer was one; any other error as it is."""
    code = code_of(error)
    if code == UNSUPPORTED_VERSION:
        return RefusalError(_NEITHER_VERSION, code=code)
    if code in _REFUSED_CLIENTS:
        client = "a client without a name" if broker.username is None else f"user {broker.username!r}"
        certificate = "" if broker.certificate_file is None else ", mqtt.certificate_file"
        return RefusalError(
            f"it refuses {client} ({error}); see mqtt.username, mqtt.password_file{certificate}", code=code
        )
    return error


def code_of(error: Exception) -> int | None:
    """Return the reason code of MQTT in an error; None if there is none."""
    return error.code if isinstance(error, BrokerError) else None
