"""Frames of the valve-board protocol, version 1; see hardware/PROTOCOL.md.

Little endian. Header: magic, version, kind, payload length, sequence, sender's monotonic
time [ns]. Then the payload, then 16 bytes of HMAC-SHA256 over header and payload.
"""

import hmac
import struct
from enum import IntEnum
from typing import NamedTuple

MAGIC, VERSION = b"SORO", 1
HEADER = struct.Struct("<4sBBHIQ")
TAG_SIZE, MAX_PAYLOAD = 16, 512
MAX_FRAME = HEADER.size + MAX_PAYLOAD + TAG_SIZE
NONCE_SIZE = 16


class Kind(IntEnum):
    """What a frame says; the board sends CHALLENGE, WELCOME, STATE, REFUSED, HEARTBEAT."""

    CHALLENGE = 1
    HELLO = 2
    WELCOME = 3
    ARM = 4
    SET = 5
    STATE = 6
    VENT = 7
    PING = 8
    REFUSED = 9
    BYE = 10
    WATCH = 11
    HEARTBEAT = 12


class Frame(NamedTuple):
    """One message.

    Attributes:
        kind: What it says, a `Kind`.
        sequence: Its number; in each direction they rise.
        time: On the monotonic clock of the sender [ns].
        payload: What it carries.
        signed, tag: Header and payload as they arrived, and their signature; both empty in a
            frame to be sent.
    """

    kind: int
    sequence: int
    time: int
    payload: bytes = b""
    signed: bytes = b""
    tag: bytes = b""


def encode(frame: Frame, key: bytes) -> bytes:
    """The bytes of a frame, signed with `key`.

    Args:
        frame: The frame.
        key: Of the session.

    Returns:
        The bytes.
    """
    if len(frame.payload) > MAX_PAYLOAD:
        raise ValueError(
            f"encode: the payload has {len(frame.payload)} bytes, need {MAX_PAYLOAD} or fewer."
        )
    signed = HEADER.pack(
        MAGIC, VERSION, frame.kind, len(frame.payload), frame.sequence, frame.time
    )
    signed += frame.payload
    return signed + _tag(key, signed)


def authentic(frame: Frame, key: bytes) -> bool:
    """Whether the holder of `key` sent the frame; takes the same time either way.

    Args:
        frame: The frame.
        key: Of the session.

    Returns:
        Whether the signature is right.
    """
    return hmac.compare_digest(_tag(key, frame.signed), frame.tag)


def _tag(key: bytes, signed: bytes) -> bytes:
    return hmac.digest(key, signed, "sha256")[:TAG_SIZE]


class Keys(NamedTuple):
    """Keys of one connection: `to_board` signs what the client sends, `to_client` what the
    board does."""

    to_board: bytes
    to_client: bytes


def session_keys(shared: bytes, board_nonce: bytes, client_nonce: bytes) -> Keys:
    """Keys from the shared key and both nonces: no frame of another session fits.

    Args:
        shared: The key that board and client share.
        board_nonce: Random bytes of the board.
        client_nonce: Random bytes of the client.

    Returns:
        A key for each direction.
    """
    session = hmac.digest(shared, b"sorojax-board 1" + board_nonce + client_nonce, "sha256")
    return Keys(*(hmac.digest(session, way, "sha256") for way in (b"board", b"client")))


def challenge_key(shared: bytes) -> bytes:
    """Key of the one frame that comes before the nonces are exchanged.

    Args:
        shared: The key that board and client share.

    Returns:
        The key.
    """
    return hmac.digest(shared, b"sorojax-board 1 challenge", "sha256")


class Decoder:
    """Cuts a stream into frames, whatever pieces it arrives in.

    Never raises and never holds more than one frame. A stream that is no stream of frames
    is `broken`, with the reason, and stays so: after that nothing in it can be trusted.
    Signatures are the caller's to check, who knows the key.
    """

    def __init__(self):
        self._buffer = b""
        self.broken = ""

    @property
    def held(self) -> int:
        """Bytes that wait for the rest of their frame."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Frame]:
        frames, view = [], self._buffer + data
        at = 0
        while not self.broken and len(view) - at >= HEADER.size:
            magic, version, kind, length, sequence, time = HEADER.unpack_from(view, at)
            self.broken = _fault(magic, version, length)
            end = at + HEADER.size + length
            if self.broken or len(view) < end + TAG_SIZE:
                break
            signed, tag = view[at:end], view[end : end + TAG_SIZE]
            frames.append(Frame(kind, sequence, time, signed[HEADER.size :], signed, tag))
            at = end + TAG_SIZE
        self._buffer = b"" if self.broken else view[at:]
        return frames


def _fault(magic: bytes, version: int, length: int) -> str:
    if magic != MAGIC:
        return "not a frame of this protocol"
    if version != VERSION:
        return f"protocol version {version}, need {VERSION}"
    if length > MAX_PAYLOAD:
        return f"payload of {length} bytes, need {MAX_PAYLOAD} or fewer"
    return ""
