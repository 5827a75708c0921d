# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""As much of HTTP/2 (RFC 9113) and gRPC as a peer needs to misuse it."""

import struct

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
HEADERS, RST_STREAM, SETTINGS, PING = 1, 3, 4, 6
END_HEADERS = 4


def frame(kind, flags, stream, payload=b""):
    return struct.pack(">I", len(payload))[1:] + struct.pack(">BBI", kind, flags, stream) + payload


def headers(path):
    """A call of gRPC: POST and http by their places in the static table (RFC 7541), the others as they are."""

    def text(value):
        return bytes([len(value)]) + value

    named = [(b"content-type", b"application/grpc"), (b"te", b"trailers")]
    block = b"\x83\x86\x04" + text(path.encode()) + b"\x01" + text(b"robot")
    return block + b"".join(b"\x00" + text(name) + text(value) for name, value in named)
