"""Who may open the live page: requests as bytes on a socket, and the status of each answer."""

import asyncio
import logging

import pytest
from page_client import served

from resonator_daemon.extensions.live_page.hub import Sources

TOKEN = b"0123456789abcdef"
BEARER = b"Authorization: Bearer " + TOKEN
UPGRADE = (b"Upgrade: websocket", b"Connection: Upgrade", b"Sec-WebSocket-Version: 13")
KEY = b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="
FORM = b"application/x-www-form-urlencoded"


def get(*headers: bytes, path: bytes = b"/", host: bytes = b"127.0.0.1:8600") -> bytes:
    return b"\r\n".join((b"GET " + path + b" HTTP/1.1", b"Host: " + host, *headers, b"", b""))


def of(host: bytes) -> bytes:
    return get(BEARER, host=host)


def origin(text: bytes) -> bytes:
    return get(BEARER, b"Origin: " + text)


def at(path: bytes) -> bytes:
    return get(BEARER, path=path)


def identified(text: bytes) -> bytes:
    return get(b"Authorization: " + text)


def opening(*headers: bytes) -> bytes:
    return get(BEARER, *headers, path=b"/ws")


def login(body: bytes, kind: bytes = FORM, *headers: bytes) -> bytes:
    length = b"Content-Length: %d" % len(body)
    return get(b"Content-Type: " + kind, length, *headers).replace(b"GET /", b"POST /login", 1) + body


REQUESTS = {
    101: [opening(*UPGRADE, KEY), opening(*UPGRADE, KEY, b"Origin: http://127.0.0.1:8600")],
    200: [
        *map(of, b"LOCALHOST:8600 127.0.0.1 127.0.0.2:1 [::1] [::1]:65535".split()),
        get(BEARER, b"Cookie: of_another_program=\xff\xe4"),
        get(BEARER, b"If-Modified-Since: Thu, 01 Jan 99999999999999999999 00:00:00 GMT"),
        get(BEARER, b"Origin: http://[0:0::1]:8600", host=b"[::1]:8600"),
        identified(b"bearer " + TOKEN),
        at(b"/uplot/uPlot.min.css"),
    ],
    303: [login(b"token=" + TOKEN), login(b"token=%30123456789abcdef&x=%ff", FORM + b"; charset=none")],
    400: [
        *map(of, b"[ [] [::1 [::1]x [::1%lo] [1] ::1 127.0.0.1: 127.0.0.1:0 127.0.0.1:65536 127.0.0.1:-1".split()),
        *map(of, b"localhost:x evil@127.0.0.1 127.0.0.1#x 127.0.0.1/x localhost?x 127.0.0.1\\x %31 \xff".split()),
        *map(of, (b"", b"a b", b"127.0.0.1\tx", b"x\0", b"127.0.0.1:\xb2", b"127.0.0.1\r\nHost: evil.example")),
        get(BEARER).replace(b"Host: 127.0.0.1:8600\r\n", b""),
        *map(origin, b"http://[ http:// http://\xff http://a@127.0.0.1:8600 http://127.0.0.1:8600/".split()),
        get(BEARER, b"Origin: http://127.0.0.1:8600", b"Origin: http://evil.example"),
        *map(identified, (b"Bearer \xff", b"\xff", BEARER + b"\xff", b"Bearer \xed\xa0\x80", b"Bearer " + b"a" * 9000)),
        get(BEARER, BEARER),
        *map(at, (b"/\xff", b"x", b"http://[/")),
        opening(*UPGRADE, b"Sec-WebSocket-Key: x"),
        opening(*UPGRADE, KEY, b"Origin: http://["),
        *(login(b"token=" + TOKEN, kind) for kind in (b"text/plain", b"\xff", b"", b"application/json", FORM + b"\0")),
        login(b"--b\r\n", b"multipart/form-data"),
        b"\xff\r\n\r\n",
    ],
    401: [
        get(),
        get(path=b"/ws"),
        *map(identified, (b"", b"Bearer", b"Bearer ", b"Basic " + TOKEN, b"Bearer " + TOKEN[1:])),
        *(get(b"Cookie: " + text) for text in (b"\xff", b"=", b";", b"resonatord_view_8600=\xff")),
        *map(login, (b"", b"token=", b"token=\xff", b"token=%ed%a0%80", b"token=" + TOKEN[1:], b"&" * 2000)),
        login(b"token=\0", FORM, b"Content-Encoding: gzip"),
    ],
    403: [
        *map(of, b"evil.example localhost.evil.example 127.1 2130706433 0 [::] [fe80::1]".split()),
        *map(origin, b"null //127.0.0.1:8600 file://127.0.0.1:8600 http://localhost:8600 http://127.0.0.1".split()),
        at(b"http://evil.example/"),
        opening(*UPGRADE, KEY, b"Origin: http://evil.example"),
    ],
    404: [
        *map(at, b"/login /.. /%2f /..%2faccess.py /uplot /uplot/ //etc/passwd /%00 /%ff".split()),
        at(b"/" + b"a" * 500),
    ],
    413: [login(b"token=" + b"x" * 1_200_000)],
}


async def test_each_request_has_its_status_and_none_leaves_a_traceback(caplog: pytest.LogCaptureFixture) -> None:
    async with served(Sources(None), token=TOKEN.decode()) as url:
        for status, requests in REQUESTS.items():
            for request in requests:
                reader, writer = await asyncio.open_connection("127.0.0.1", int(url.split(":")[2].strip("/")))
                writer.write(request)
                answer = await asyncio.wait_for(reader.readline(), 30)
                writer.close()
                assert (status, request[:200]) == (int(answer[9:12] or b"0"), request[:200])
    assert [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING] == []
