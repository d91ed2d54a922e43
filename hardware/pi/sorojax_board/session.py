"""One connection to the board: handshake, order of frames, and what each one asks for."""

import os
from collections.abc import Callable

from sorojax_board import messages
from sorojax_board.board import Board
from sorojax_board.frames import (
    NONCE_SIZE,
    Decoder,
    Frame,
    Keys,
    Kind,
    authentic,
    challenge_key,
    encode,
    session_keys,
)
from sorojax_board.messages import Malformed, Refusal, Welcome

HANDSHAKE, _AGE = 2.0, 0.1  # s
_FASTEST_BEAT, _SLOWEST_BEAT = 0.002, 10.0  # s
READER, WRITER = 0, 1


class Session:
    """Speaks for one client; `receive` takes bytes of any length and returns the answer.

    A stream that is not this protocol, or not signed by the holder of the key, closes the
    session (`closed` says why); a frame that arrives too late, twice or with nonsense in
    it is refused by itself. Nothing raises. `ready` says that the client said a valid hello,
    `last_heard` when it was heard last [s].
    """

    def __init__(self, board: Board, shared: bytes, now: float, nonce: bytes | None = None):
        self.board, self.closed = board, ""
        self._shared, self._opened = shared, now
        self._nonce = os.urandom(NONCE_SIZE) if nonce is None else nonce
        self._decoder, self._keys = Decoder(), Keys(b"", b"")
        self.ready, self._writer = False, False
        self.last_heard = now  # an authentic frame
        self._sent, self._heard = 0, 0
        self._delay = float("inf")  # least difference of the clocks seen so far, s
        self._beat, self._due = 0.0, float("inf")  # period and time of the next heartbeat, s
        self._actions: dict[int, Callable[[Frame, float], bytes]] = {
            Kind.ARM: self._arm, Kind.SET: self._set, Kind.VENT: self._vent,
            Kind.PING: self._ping, Kind.BYE: self._bye, Kind.WATCH: self._watch,
        }  # fmt: skip

    def challenge(self, now: float) -> bytes:
        """The first bytes of the conversation."""
        frame = Frame(Kind.CHALLENGE, 0, int(now * 1e9), self._nonce)
        return encode(frame, challenge_key(self._shared))

    def receive(self, data: bytes, now: float) -> bytes:
        answers = []
        for frame in self._decoder.feed(data):
            if self.closed:
                break
            answers.append(self._accept(frame, now))
        if self._decoder.broken and not self.closed:
            self.close(self._decoder.broken, now)
        return b"".join(answers)

    def tick(self, now: float) -> bytes:
        """The heartbeat where one is due; a connection that does not say hello is closed."""
        if not self.ready and not self.closed and now - self._opened > HANDSHAKE:
            self.close("no hello in time", now)
        if self.closed or now < self._due:
            return b""
        self._due = max(self._due + self._beat, now)
        return self._answer(Kind.HEARTBEAT, messages.pack_report(self.board.report()), now)

    def lost(self, now: float) -> None:
        """The socket is gone."""
        self.close(self.closed or "connection lost", now)

    def state(self, now: float) -> bytes:
        """The board's state, empty before the handshake."""
        if not self.ready or self.closed:
            return b""
        return self._answer(Kind.STATE, messages.pack_report(self.board.report()), now)

    def close(self, why: str, now: float) -> None:
        """Speak for nobody from now on; the writer's board vents."""
        self.closed = why
        self.board.lost(self, now)

    def _accept(self, frame: Frame, now: float) -> bytes:
        if not self.ready:
            return self._hello(frame, now)
        if not authentic(frame, self._keys.to_board):
            self.close("a frame that is not signed with the key of this session", now)
            return b""
        if frame.sequence <= self._heard:
            return self._refuse(frame, Refusal.REPLAYED, now)
        self._heard, self.last_heard = frame.sequence, now
        if self._late(frame, now):
            return self._refuse(frame, Refusal.STALE, now)
        action = self._actions.get(frame.kind)
        if action is None:
            return self._refuse(frame, Refusal.MALFORMED, now)
        try:
            return action(frame, now)
        except Malformed:
            return self._refuse(frame, Refusal.MALFORMED, now)

    def _late(self, frame: Frame, now: float) -> bool:
        """Whether the frame was under way much longer than the fastest one so far."""
        delay = now - frame.time * 1e-9
        self._delay = min(self._delay, delay)
        return delay - self._delay > _AGE

    def _hello(self, frame: Frame, now: float) -> bytes:
        nonce, role = frame.payload[:NONCE_SIZE], frame.payload[NONCE_SIZE:]
        if frame.kind != Kind.HELLO or role not in (bytes([READER]), bytes([WRITER])):
            self.close("no hello", now)
            return b""
        keys = session_keys(self._shared, self._nonce, nonce)
        if not authentic(frame, keys.to_board):
            self.close("hello signed with another key", now)
            return b""
        self._keys, self.ready = keys, True
        self._heard, self.last_heard = frame.sequence, now
        self._writer = role == bytes([WRITER])
        self._late(frame, now)
        limits = self.board.settings
        told = Welcome(limits.watchdog, limits.ramp, limits.limits)
        return self._answer(Kind.WELCOME, messages.pack_welcome(told), now)

    def _arm(self, frame: Frame, now: float) -> bytes:
        ranges = messages.unpack_arm(frame.payload, self.board.num_ports)
        taken = self.board.owner not in (None, self)
        if not self._writer or taken:
            return self._refuse(frame, Refusal.NOT_WRITER, now)
        try:
            self.board.arm(self, ranges, now)
        except ValueError:
            return self._refuse(frame, Refusal.MALFORMED, now)
        return self.state(now)

    def _set(self, frame: Frame, now: float) -> bytes:
        mask, values = messages.unpack_set(frame.payload, self.board.num_ports)
        stamp = (frame.sequence, frame.time)
        why = self.board.set(self, mask, values, stamp, now)
        if why is None:
            return self.state(now)
        return self._answer(Kind.REFUSED, messages.pack_refused(frame.sequence, why), now)

    def _vent(self, frame: Frame, now: float) -> bytes:
        self.board.vent(now)  # anybody with the key may stop the robot
        return self.state(now)

    def _ping(self, frame: Frame, now: float) -> bytes:
        return self.state(now)

    def _watch(self, frame: Frame, now: float) -> bytes:
        (period,) = messages.floats(frame.payload, 1)
        if period and not _FASTEST_BEAT <= period <= _SLOWEST_BEAT:
            raise Malformed(f"period {period} s")
        self._beat, self._due = period, now + period if period else float("inf")
        return self.state(now)

    def _bye(self, frame: Frame, now: float) -> bytes:
        if self.board.owner is self:
            self.board.vent(now)
            self.board.owner = None
        self.close("the client said goodbye", now)
        return b""

    def _refuse(self, frame: Frame, why: Refusal, now: float) -> bytes:
        self.board.refused += 1
        return self._answer(Kind.REFUSED, messages.pack_refused(frame.sequence, why), now)

    def _answer(self, kind: Kind, payload: bytes, now: float) -> bytes:
        self._sent += 1
        frame = Frame(kind, self._sent, int(now * 1e9), payload)
        return encode(frame, self._keys.to_client)
