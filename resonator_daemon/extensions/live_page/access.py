"""Access control of the live page: host, origin and token of requests, headers of answers, and secrets in files."""

import hmac
import json
import re
import secrets
import ssl
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from ipaddress import IPv6Address
from pathlib import Path
from typing import Final
from urllib.parse import parse_qs

from aiohttp import hdrs, web

from resonator_daemon.base.errors import ConfigurationError
from resonator_daemon.board.config.broker_files import (
    BrokerFile,
    UnusableFileError,
    read_certificates,
    read_key,
    read_password,
)
from resonator_daemon.board.config.mqtt import is_this_computer
from resonator_daemon.mqtt.connecting import LEAST_VERSION

COOKIE: Final = "resonatord_view_{}"  # with the port: browsers send the cookies of a host to all of its ports
LOGIN: Final = "/login"
TOKEN_CHARACTERS_MIN: Final = 16
_SESSIONS_MAX: Final = 1000
_HOST: Final = re.compile(r"(?:\[([0-9a-f:.]+)\]|([0-9a-z._-]+))(?::(\d{1,5}))?", re.ASCII | re.IGNORECASE)
_PORT_MAX: Final = 65535
_ONCE: Final = (hdrs.HOST, hdrs.ORIGIN, hdrs.AUTHORIZATION)
_LOGIN_TYPE: Final = "application/x-www-form-urlencoded"
_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; worker-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
}
_FORM: Final = """<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>resonatord</title><h1>resonatord</h1><p>{}</p>
<form method="post" action="/login"><label>Token <input name="token" type="password" autocomplete="current-password"
required autofocus></label> <button>Open</button></form></html>"""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Access:
    """Rules for the requests of one server.

    Parameters
    ----------
    host
        The address that the server listens on.
    token
        That browsers have to send once, and programs as `Authorization: Bearer`; None: everybody
        who reaches the page may open it.
    tls
        Whether cookies are sent over TLS only.
    """

    def __init__(self, host: str, token: str | None, *, tls: bool) -> None:
        self._loopback = is_this_computer(host)
        self._token = None if token is None else token.encode()
        self._tls = tls
        self._sessions: OrderedDict[str, None] = OrderedDict()

    def protect(self, app: web.Application) -> None:
        """Apply the rules to all routes, and add the one that takes the token."""

        @web.middleware
        async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
            try:
                return self._refusal(request) or await handler(request)
            except _MalformedRequestError as error:
                return _refused(400, "bad_request", str(error))

        async def add_headers(_request: web.Request, response: web.StreamResponse) -> None:
            response.headers.update(_HEADERS)

        app.middlewares.append(check)
        app.on_response_prepare.append(add_headers)
        if self._token is not None:
            app.router.add_post(LOGIN, self._log_in)

    def _refusal(self, request: web.Request) -> web.Response | None:
        """Return the answer to a request that is not allowed, None if it is."""
        headers = request.headers
        # Cookies of other programs of this computer, which browsers send with each request, may have other characters.
        if not all(value.isascii() for name, value in headers.items() if name.lower() != "cookie"):
            raise _MalformedRequestError("only ASCII characters are allowed in headers")
        if any(len(headers.getall(name, ())) > 1 for name in _ONCE):
            raise _MalformedRequestError(f"{' and '.join(_ONCE)} may each be given only once")
        host = _read_host(request.host)
        if self._loopback and not is_this_computer(host[0]):
            # DNS rebinding: a page of another site whose name resolves to this address.
            return _refused(403, "wrong_host", "open this page by the address that `resonatord view` printed")
        scheme, _, origin = headers.get(hdrs.ORIGIN, f"http://{request.host}").partition("://")
        if scheme not in ("http", "https") or _read_host(origin) != host:
            return _refused(403, "wrong_origin", "another site's page may not use this server")
        if self._token is None or request.path == LOGIN or self._is_authorized(request):
            return None
        if "text/html" in request.headers.get(hdrs.ACCEPT, ""):
            return _form(401, "This page needs the token of the person who runs it.")
        return _refused(401, "no_token", "send the token as `Authorization: Bearer TOKEN`")

    def _is_authorized(self, request: web.Request) -> bool:
        kind, _, token = request.headers.get(hdrs.AUTHORIZATION, "").partition(" ")
        return request.cookies.get(_cookie(request)) in self._sessions or (
            kind.lower() == "bearer" and self._is_token(token)
        )

    def _is_token(self, token: str) -> bool:
        return self._token is not None and hmac.compare_digest(token.strip().encode(), self._token)

    async def _log_in(self, request: web.Request) -> web.StreamResponse:
        if request.content_type != _LOGIN_TYPE:
            raise _MalformedRequestError(f"send the token as {_LOGIN_TYPE}")
        fields = parse_qs((await request.read()).decode("ascii", "replace"))
        if not self._is_token(fields.get("token", [""])[0]):
            return _form(401, "This is not the token. Try again.")
        session = secrets.token_urlsafe(32)
        self._sessions[session] = None
        if len(self._sessions) > _SESSIONS_MAX:
            self._sessions.popitem(last=False)
        response = web.Response(status=303, headers={hdrs.LOCATION: "/"})
        response.set_cookie(_cookie(request), session, httponly=True, samesite="Strict", secure=self._tls)
        return response


class _MalformedRequestError(Exception):
    """A request with malformed headers or a malformed form."""


def _cookie(request: web.Request) -> str:
    return COOKIE.format(_read_host(request.host)[1])


def _read_host(text: str) -> tuple[str, str]:
    """Return host and port of `HOST[:PORT]`, the port empty if there is none."""
    parts = _HOST.fullmatch(text)
    try:
        if parts is not None and (parts[3] is None or 0 < int(parts[3]) <= _PORT_MAX):
            return str(IPv6Address(parts[1])) if parts[1] else parts[2].lower(), parts[3] or ""
    except ValueError:
        pass  # the brackets contain no IPv6 address
    raise _MalformedRequestError("Host and Origin must be HOST or HOST:PORT, with a port from 1 to 65535")


def _refused(status: int, code: str, message: str) -> web.Response:
    body = json.dumps({"error": {"code": code, "message": message}})
    return web.Response(status=status, text=body, content_type="application/json")


def _form(status: int, sentence: str) -> web.Response:
    return web.Response(status=status, text=_FORM.format(sentence), content_type="text/html")


def read_token(path: Path) -> str:
    """Return the token in a file, alone on one line.

    Raises
    ------
    ConfigurationError
        The file cannot be read, or the token can be guessed.
    """
    try:
        token = read_password(BrokerFile(str(path), path), "token")
    except UnusableFileError as error:
        raise ConfigurationError(f"--token-file {error}") from None
    if len(token) < TOKEN_CHARACTERS_MIN or not token.isascii():
        raise ConfigurationError(
            f"--token-file {path}: the token has {len(token)} characters; at least {TOKEN_CHARACTERS_MIN}, all ASCII, "
            f"are needed. Make one: openssl rand -hex 16 > {path}"
        )
    return token


def tls_of(certificate: Path, key: Path) -> ssl.SSLContext:
    """Return the context of a server with this certificate and key.

    Raises
    ------
    ConfigurationError
        One of both cannot be used.
    """
    certificate_file, key_file = BrokerFile(str(certificate), certificate), BrokerFile(str(key), key)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = LEAST_VERSION
    try:
        read_certificates(certificate_file)
        read_key(key_file)
        context.load_cert_chain(certificate, key)
    except UnusableFileError as error:
        raise ConfigurationError(f"--tls-certificate, --tls-key: {error}") from None
    except ssl.SSLError as error:
        raise ConfigurationError(
            f"--tls-key {key}: cannot be used with {certificate} ({error.reason}); name both of a pair"
        ) from None
    return context
