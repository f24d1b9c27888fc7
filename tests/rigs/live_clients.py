"""Clients of a WebSocket server that do what no viewer does."""

from __future__ import annotations

import json
import os
import socket
import struct

HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
)
CHANNELS = 40
"""More than there are."""


def raw(port: int) -> socket.socket:
    """A connection without a handshake."""
    connection = socket.create_connection(("127.0.0.1", port), 5.0)
    connection.settimeout(10.0)
    return connection


def frame(text: str) -> bytes:
    """A client's text frame (RFC 6455, section 5.2), masked with zeros, of 126 to 65535 bytes."""
    data = text.encode()
    assert 126 <= len(data) < 1 << 16
    return b"\x81" + struct.pack(">BH", 0x80 | 126, len(data)) + bytes(4) + data


def stall(port: int) -> socket.socket:
    """A client that subscribes to everything and never reads."""
    connection = raw(port)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.sendall(HANDSHAKE)
    answer = b""
    while b"\r\n\r\n" not in answer:
        answer += connection.recv(1)
    assert b" 101 " in answer, answer
    wanted = [{"id": k, "channelId": k} for k in range(1, CHANNELS)]
    connection.sendall(frame(json.dumps({"op": "subscribe", "subscriptions": wanted})))
    return connection


def noise() -> tuple[bytes, ...]:
    """What is no request, or half of one."""
    return (
        bytes(100),
        b"GET / HTTP/1.1\r\n\r\n",
        os.urandom(20_000),
        b"GET / HTTP/1.1\r\nUpgrade: websocket\r\n\r\n",
        b"GET /" + b"x" * 20_000,
    )
