"""MAVLink 2 signing: frames that only holders of a key can make, each of them once.

Source: https://mavlink.io/en/guide/message_signing.html
"""

from __future__ import annotations

import hashlib
import hmac
import re
import time

from testbed.errors import UserError

SIGNED = 0x01  # incompatibility flag of a signed frame
SIGNATURE_BYTES = 13  # link, 48 bits of time, 48 bits of signature

_LINK = 1  # of our own signatures
_TICK_S = 1e-5  # unit of the time in a signature
_EPOCH_S = 1_420_070_400  # 2015-01-01T00:00Z, where it begins
_NEW_STREAM_TICKS = 6_000_000  # a talker that is new may be a minute behind
_SHORTEST_HEX = 32  # hexadecimal digits that can't be meant as a passphrase


def key_bytes(text: str) -> bytes:
    """The 32 bytes of a key given as 64 hexadecimal digits, or as a passphrase, hashed as ground stations hash it.

    Raises UserError when it is empty, or hexadecimal digits of another length.
    """
    if re.fullmatch(r"[0-9a-fA-F]{64}", text):
        return bytes.fromhex(text)
    if not text.strip():
        raise UserError("--mavlink-key: is empty: give a passphrase, or 64 hexadecimal digits")
    if re.fullmatch(rf"[0-9a-fA-F]{{{_SHORTEST_HEX},}}", text):
        raise UserError(
            f"--mavlink-key: has {len(text)} hexadecimal digits, a key has 64: complete it, or give a passphrase"
        )
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).digest()


class Signing:
    """One key: signs what goes out, and knows what may come in, over all links."""

    def __init__(self, key: str) -> None:
        """Take a key as `key_bytes` does."""
        self._key = key_bytes(key)
        self._now = 0
        self._heard: dict[tuple[int, int, int], int] = {}  # time of the newest by link, system, component

    def sign(self, frame: bytes) -> bytes:
        """``frame`` with its signature; it must carry the flag already."""
        self._now = max(self._now + 1, _clock())
        stamped = frame + bytes((_LINK,)) + self._now.to_bytes(6, "little")
        return stamped + self._digest(stamped)

    def accepts(self, frame: bytes, system: int, component: int) -> bool:
        """Whether a frame with the flag was signed with the key, and later than all that came that way before."""
        stamped = frame[:-6]
        if not hmac.compare_digest(self._digest(stamped), frame[-6:]):
            return False
        when = int.from_bytes(stamped[-6:], "little")
        source = (stamped[-7], system, component)
        self._now = max(self._now, _clock())
        if when <= self._heard.get(source, self._now - _NEW_STREAM_TICKS - 1):
            return False
        self._heard[source] = when
        self._now = max(self._now, when)
        return True

    def _digest(self, stamped: bytes) -> bytes:
        return hashlib.sha256(self._key + stamped).digest()[:6]


def _clock() -> int:
    return int((time.time() - _EPOCH_S) / _TICK_S)
