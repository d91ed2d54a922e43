"""Mutated, split and merged streams on both decoders of the valve board."""

import random
import struct
from time import process_time

from benchmarks.harness import Row
from sorojax_board import messages
from sorojax_board.board import Board, settings
from sorojax_board.frames import (
    MAX_FRAME,
    NONCE_SIZE,
    Decoder,
    Frame,
    Kind,
    encode,
    session_keys,
)
from sorojax_board.legacy import LegacySession
from sorojax_board.session import WRITER, Session

STREAMS = 200_000
KEY, NONCE = bytes(range(32)), bytes(NONCE_SIZE)


class _Valves:
    def __init__(self):
        self.told = (0.0,) * 2

    def write(self, pressures):
        self.told = tuple(pressures)

    def read(self, now):
        return self.told


def rows():
    for name, attack in (
        ("board, framed", _framed),
        ("board, raw stream", _raw),
        ("client", _client),
    ):
        start = process_time()
        escaped, forged, held, outside = attack(random.Random(0))
        settings_ = {"decoder": name, "streams": STREAMS, "most_bytes_held": held}
        yield Row(
            "sorojax",
            settings_,
            0.0,
            *(3 * [(process_time() - start) / STREAMS]),
            error=float(escaped + forged + outside),
            bar=0.0,
            bar_on="error",
            reference="exceptions, forged frames and commands outside the limits",
        )


def _mutated(dice: random.Random, frames: list[bytes]) -> bytes:
    """Some frames with flipped bytes, cuts, repeats and rubbish between them."""
    stream = b""
    for _ in range(dice.randint(1, 3)):
        data = bytearray(dice.choice(frames))
        for at in dice.sample(range(len(data)), dice.randint(1, 4)):
            data[at] ^= dice.randint(1, 255)
        stream += bytes(data[: dice.choice((len(data), dice.randrange(len(data))))])
        stream += dice.randbytes(dice.choice((0, 0, 7)))
    return stream


def _pieces(dice: random.Random, stream: bytes):
    while stream:
        size = dice.randint(1, len(stream))
        yield stream[:size]
        stream = stream[size:]


def _framed(dice: random.Random):
    escaped = forged = held = outside = 0
    keys = session_keys(KEY, NONCE, NONCE)
    for _ in range(STREAMS // 100):
        valves = _Valves()
        board = Board(settings(2, low=-10e3, high=60e3), valves)
        for k in range(100):
            session = Session(board, KEY, 0.0, NONCE)
            hello = Frame(Kind.HELLO, 1, 0, NONCE + bytes([WRITER]))
            arm = Frame(Kind.ARM, 2, 0, messages.pack_arm([(-1e9, 1e9)] * 2))
            session.receive(encode(hello, keys.to_board) + encode(arm, keys.to_board), 0.0)
            wanted = messages.pack_set(3, [1e9, 5e4])
            good = [encode(Frame(Kind.SET, n, 0, wanted), keys.to_board) for n in (3, 4)]
            try:
                for piece in _pieces(dice, _mutated(dice, good)):
                    session.receive(piece, 0.0)
                    held = max(held, session._decoder.held)
                board.tick(0.001 * k)
            except Exception:  # whatever escapes a decoder is what is counted
                escaped += 1
            forged += valves.told != (0.0, 0.0)
            outside += not all(-10e3 <= p <= 60e3 for p in valves.told) or held > MAX_FRAME
            session.lost(0.001 * k)
    return escaped, forged, held, outside


def _raw(dice: random.Random):
    """Any sane number is a command there, so only exceptions and limits can be judged."""
    escaped = held = outside = 0
    for _ in range(STREAMS // 100):
        valves = _Valves()
        board = Board(settings(2, low=-10e3, high=60e3), valves)
        good = [struct.pack("<2d", 0.6, 0.7), struct.pack("<2d", 1.0, 0.5)]
        for k in range(100):
            session = LegacySession(board, 0.001 * k)
            try:
                for piece in _pieces(dice, _mutated(dice, good)):
                    session.receive(piece, 0.001 * k)
                    held = max(held, len(session._buffer))
                board.tick(0.001 * k)
            except Exception:  # whatever escapes a decoder is what is counted
                escaped += 1
            outside += not all(-10e3 <= p <= 60e3 for p in valves.told)
            session.lost(0.001 * k)
    return escaped, 0, held, outside


def _client(dice: random.Random):
    from sorojax_board.frames import authentic

    escaped = forged = held = 0
    keys = session_keys(KEY, NONCE, NONCE)
    report = Board(settings(2), _Valves()).report()
    good = [encode(Frame(Kind.STATE, 1, 0, messages.pack_report(report)), keys.to_client)]
    for _ in range(STREAMS):
        decoder = Decoder()
        try:
            for piece in _pieces(dice, _mutated(dice, good)):
                for frame in decoder.feed(piece):
                    forged += (
                        authentic(frame, keys.to_client)
                        and encode(Frame(*frame[:4]), keys.to_client) not in good
                    )
                held = max(held, decoder.held)
        except Exception:  # whatever escapes a decoder is what is counted
            escaped += 1
    return escaped, forged, held, 0
