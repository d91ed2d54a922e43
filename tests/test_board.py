"""The valve board: frames, sessions, the safety state machine, drivers; no socket, no wait."""

import hashlib
import hmac
import struct

import numpy as np
import pytest
from hypothesis import given, settings as budget, strategies as st

from sorojax_board import messages
from sorojax_board.bench import STEP, BenchValves
from sorojax_board.board import Board, settings
from sorojax_board.frames import (
    HEADER,
    MAX_FRAME,
    NONCE_SIZE,
    TAG_SIZE,
    Decoder,
    Frame,
    Kind,
    authentic,
    challenge_key,
    encode,
    session_keys,
)
from sorojax_board.i2c import (
    PLATFORM,
    I2CValves,
    adc_pressure,
    adc_request,
    dac_code,
    dac_pressure,
    pressure_of_command,
    voltage_of_pressure,
)
from sorojax_board.legacy import LegacySession
from sorojax_board.messages import Fault, Flag, Refusal, State
from sorojax_board.session import READER, WRITER, Session

KEY = bytes(range(32))
kPa = 1e3
TICK = 0.002


class Still:
    """Valves that are where they are told to be, and remember what they were told."""

    def __init__(self, ports=2):
        self.pressure, self.told = [0.0] * ports, []

    def write(self, pressures):
        self.pressure = list(pressures)
        self.told.append(self.pressure)

    def read(self, now):
        return self.pressure


class Client:
    """A writer whose frames can be sent late, twice or changed."""

    def __init__(self, board, now=0.0, key=KEY, role=WRITER):
        self.board, self.sequence = board, 0
        self.session = Session(board, KEY, now, nonce=bytes(NONCE_SIZE))
        nonce = bytes(NONCE_SIZE)
        self.keys = session_keys(key, bytes(NONCE_SIZE), nonce)
        self.answer = self.say(Kind.HELLO, nonce + bytes([role]), now)

    def frame(self, kind, payload=b"", now=0.0):
        self.sequence += 1
        frame = Frame(kind, self.sequence, int((now + 100) * 1e9), payload)
        return encode(frame, self.keys.to_board)

    def say(self, kind, payload=b"", now=0.0):
        return self.hear(self.session.receive(self.frame(kind, payload, now), now))

    def hear(self, data):
        frames = Decoder().feed(data)
        assert all(authentic(frame, self.keys.to_client) for frame in frames)
        return frames[-1] if frames else None

    def arm(self, now=0.0, low=-100 * kPa, high=100 * kPa):
        ranges = [(low, high)] * self.board.num_ports
        return self.say(Kind.ARM, messages.pack_arm(ranges), now)

    def set(self, values, now=0.0, mask=0xFFFFFFFF):
        return self.say(Kind.SET, messages.pack_set(mask, values), now)


def armed(ports=2, **more):
    valves = Still(ports)
    board = Board(settings(ports, **more), valves)
    client = Client(board)
    client.arm()
    return board, valves, client


def run(board, start, stop, step=TICK):
    for now in np.arange(start + step, stop + 1e-9, step):
        board.tick(now)


def refusal(frame):
    assert frame.kind == Kind.REFUSED
    return messages.unpack_refused(frame.payload)[1]


@pytest.mark.stress(52)
def test_frames_survive_any_cut():
    frames = [Frame(Kind.SET, k, 10 * k, bytes(range(4 * k))) for k in range(1, 6)]
    data = b"".join(encode(frame, KEY) for frame in frames)
    for cut in range(1, len(data)):
        decoder = Decoder()
        got = decoder.feed(data[:cut]) + decoder.feed(data[cut:])
        assert [frame[:4] for frame in got] == [frame[:4] for frame in frames]
        assert all(authentic(frame, KEY) for frame in got) and not decoder.broken
    decoder = Decoder()
    got = [frame for byte in data for frame in decoder.feed(bytes([byte]))]
    assert len(got) == 5 and decoder.held == 0


def test_the_signature_is_rfc_2104():
    # RFC 4231, test case 1, of which the frame keeps the first 16 bytes
    want = "b0344c61d8db38535ca8afceaf0bf12b881dc200c9833da726e9376c2e32cff7"
    assert hmac.digest(b"\x0b" * 20, b"Hi There", hashlib.sha256).hex() == want
    data = encode(Frame(Kind.PING, 1, 2, b"x"), b"\x0b" * 20)
    signed = data[:-TAG_SIZE]
    assert data[-TAG_SIZE:] == hmac.digest(b"\x0b" * 20, signed, "sha256")[:16]
    assert len(data) == HEADER.size + 1 + 16 and HEADER.size == 20


def test_no_changed_bit_passes():
    data = encode(Frame(Kind.SET, 7, 99, messages.pack_set(3, [1.0, 2.0])), KEY)
    for bit in range(8 * len(data)):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        decoder = Decoder()
        assert not any(authentic(frame, KEY) for frame in decoder.feed(bytes(changed)))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda d: b"HTTP" + d[4:], "not a frame"),
        (lambda d: d[:4] + b"\x02" + d[5:], "version 2"),
        (lambda d: d[:6] + b"\xff\xff" + d[8:], "payload of 65535"),
        (
            lambda d: struct.pack(">4sBBHIQ", b"SORO", 1, 5, 12, 1, 1) + d[20:],
            "payload of 3072",
        ),
    ],
)
def test_another_stream_is_named_and_forgotten(change, why):
    decoder = Decoder()
    assert decoder.feed(change(encode(Frame(Kind.SET, 1, 1, bytes(12)), KEY))) == []
    assert why in decoder.broken
    assert decoder.feed(bytes(10**6)) == [] and decoder.held == 0


@budget(max_examples=150, deadline=None)
@given(st.data())
def test_nothing_a_stranger_sends_moves_a_valve(data):
    """Mutated, split, merged, repeated and foreign bytes, before and after the handshake."""
    board, _, client = armed()
    good = [client.frame(Kind.SET, messages.pack_set(3, [p, p]), 0.0) for p in (1e3, 2e3)]
    start = client.session if data.draw(st.booleans()) else Session(board, KEY, 0.0)
    edits = st.tuples(st.integers(0, len(good[0]) - 1), st.integers(1, 255))
    stream = b""
    for _ in range(data.draw(st.integers(1, 4))):
        frame = bytearray(data.draw(st.sampled_from(good)))
        for at, change in data.draw(
            st.lists(edits, min_size=1, max_size=3, unique_by=lambda e: e[0])
        ):
            frame[at] ^= change
        stream += bytes(frame) + data.draw(st.binary(max_size=40))
    while stream:
        size = data.draw(st.integers(1, len(stream)))
        start.receive(stream[:size], 0.0)
        stream = stream[size:]
    assert start._decoder.held <= MAX_FRAME
    run(board, 0.0, 0.05)
    assert all(value == 0 for told in board.backend.told for value in told)


@budget(max_examples=150, deadline=None)
@given(st.lists(st.floats(width=32), min_size=2, max_size=2), st.integers(0, 2**32 - 1))
@pytest.mark.stress(53)
def test_no_setpoint_leaves_the_limits(values, mask):
    board, valves, client = armed(low=-10 * kPa, high=60 * kPa)
    client.set(values, 0.001, mask)
    run(board, 0.0, 0.09)
    told = np.array(valves.told)
    assert np.all(np.isfinite(told)) and told.min() >= -10 * kPa and told.max() <= 60 * kPa


def test_a_set_is_followed_and_reported():
    board, valves, client = armed()
    frame = client.set([50 * kPa, -20 * kPa], 0.01)
    run(board, 0.01, 0.08)
    assert frame.kind == Kind.STATE and valves.pressure == [50 * kPa, -20 * kPa]
    report = messages.unpack_report(client.say(Kind.PING, now=0.08).payload)
    assert report.state is State.ARMED and report.sequence == client.sequence - 1
    assert report.setpoint == report.pressure == (50 * kPa, -20 * kPa)


def test_masked_ports_keep_their_setpoint():
    board, valves, client = armed()
    client.set([50 * kPa, 50 * kPa], 0.0)
    client.set([10 * kPa, 20 * kPa], 0.01, mask=0b10)
    run(board, 0.0, 0.08)
    assert valves.pressure == [50 * kPa, 20 * kPa]


def test_slew_is_limited_on_the_board():
    board, valves, client = armed(slew=1e6)
    client.set([90 * kPa, 0.0], 0.0)
    run(board, 0.0, 0.02)
    assert board.report().flags[0] == Flag.SLEWING
    run(board, 0.02, 0.095)
    told = np.array(valves.told)[:, 0]
    assert np.max(np.diff(told)) <= 1e6 * TICK * (1 + 1e-9) and told[-1] == 90 * kPa


@pytest.mark.stress(52)
def test_silence_ramps_to_zero_within_600_ms_and_stays():
    board, valves, client = armed()
    client.set([80 * kPa, -30 * kPa], 0.0)
    run(board, 0.0, 0.1)
    assert valves.pressure == [80 * kPa, -30 * kPa]
    run(board, 0.1, 0.6)
    assert valves.pressure == [0.0, 0.0]
    fall = -np.diff(np.array(valves.told)[:, 0])
    assert fall.max() <= 80 * kPa / 0.45 * TICK * 1.01  # a ramp, no jump
    assert (board.state, board.fault) == (State.FAULT, Fault.WATCHDOG)
    assert refusal(client.set([5 * kPa] * 2, 0.7)) is Refusal.NOT_ARMED
    run(board, 0.7, 0.8)
    assert valves.pressure == [0.0, 0.0]
    client.arm(0.8)
    client.set([5 * kPa] * 2, 0.8)
    run(board, 0.8, 0.85)
    assert valves.pressure == [5 * kPa] * 2


@pytest.mark.stress(52)
def test_a_lost_connection_vents_and_frees_the_place_of_the_writer():
    board, valves, client = armed()
    client.set([80 * kPa] * 2, 0.0)
    run(board, 0.0, 0.05)
    client.session.lost(0.05)
    run(board, 0.05, 0.51)
    assert valves.pressure == [0.0, 0.0] and board.fault is Fault.DISCONNECTED
    other = Client(board, 0.6)
    assert messages.unpack_report(other.arm(0.6).payload).state is State.ARMED


def test_goodbye_and_vent_are_no_faults():
    board, valves, client = armed()
    client.set([80 * kPa] * 2, 0.0)
    run(board, 0.0, 0.05)
    client.say(Kind.VENT, now=0.05)
    assert (board.state, board.fault) == (State.VENTED, Fault(0))
    client.arm(0.06)
    client.say(Kind.BYE, now=0.07)
    assert board.state is State.VENTED and board.owner is None
    run(board, 0.07, 0.6)
    assert valves.pressure == [0.0, 0.0]


@pytest.mark.stress(52)
def test_one_writer_others_watch_and_may_stop_it():
    board, _, client = armed()
    second, watcher = Client(board), Client(board, role=READER)
    assert refusal(second.arm()) is Refusal.NOT_WRITER
    assert refusal(second.set([1e3, 1e3])) is Refusal.NOT_WRITER
    assert refusal(watcher.arm()) is Refusal.NOT_WRITER
    assert watcher.say(Kind.PING).kind == Kind.STATE
    watcher.say(Kind.VENT)
    assert board.state is State.VENTED
    second.session.lost(0.0)  # a bystander
    assert board.owner is client.session


def test_limits_can_only_be_narrowed():
    board, valves, client = armed(low=-10 * kPa, high=60 * kPa)
    client.arm(low=-500 * kPa, high=20 * kPa)
    client.set([50 * kPa, -50 * kPa], 0.0)
    run(board, 0.0, 0.08)
    assert valves.pressure == [20 * kPa, -10 * kPa]
    assert board.report().flags == (Flag.CLIPPED, Flag.CLIPPED)
    for low, high in ((70 * kPa, 80 * kPa), (np.nan, 1.0), (1.0, -1.0)):
        assert refusal(client.arm(0.09, low, high)) is Refusal.MALFORMED


@pytest.mark.stress(52, 53)
def test_nonsense_is_counted_and_changes_nothing():
    board, valves, client = armed()
    client.set([40 * kPa] * 2, 0.0)
    assert refusal(client.set([np.nan, 1.0], 0.01)) is Refusal.NOT_FINITE
    assert refusal(client.set([np.inf, 1.0], 0.01)) is Refusal.NOT_FINITE
    assert refusal(client.set([1.0] * 3, 0.01)) is Refusal.MALFORMED
    assert refusal(client.say(Kind.SET, b"", 0.01)) is Refusal.MALFORMED
    assert refusal(client.say(77, b"", 0.01)) is Refusal.MALFORMED
    run(board, 0.0, 0.1)
    assert valves.pressure == [40 * kPa] * 2 and board.refused == 5
    run(board, 0.1, 0.12)  # none of them fed the watchdog
    assert board.fault is Fault.WATCHDOG


@pytest.mark.stress(52)
def test_replayed_and_late_frames_are_refused():
    board, _, client = armed()
    old = client.frame(Kind.SET, messages.pack_set(3, [9e3, 9e3]), 0.0)
    client.session.receive(old, 0.0)
    assert refusal(client.hear(client.session.receive(old, 0.01))) is Refusal.REPLAYED
    held_up = client.frame(Kind.SET, messages.pack_set(3, [7e3, 7e3]), 0.02)
    assert refusal(client.hear(client.session.receive(held_up, 0.15))) is Refusal.STALE


@pytest.mark.stress(53)
def test_ten_kilohertz_are_thinned_to_one():
    board, _, client = armed()
    answers = [client.set([1e3, 1e3], 1e-4 * k).kind for k in range(1, 1001)]
    followed = answers.count(Kind.STATE)
    assert followed <= 100 + 21 and board.refused == 1000 - followed
    board.tick(0.1)
    assert board.state is State.ARMED


@pytest.mark.stress(53)
def test_a_calm_second_saves_up_no_burst():
    board, _, client = armed(watchdog=5.0)
    for now in np.arange(0.01, 1.0, 0.01):
        client.set([1e3, 1e3], now)
    answers = [client.set([2e3, 2e3], 1.0).kind for _ in range(200)]
    assert 19 <= answers.count(Kind.STATE) <= 21


def test_a_wrong_key_never_gets_in():
    board = Board(settings(2), Still())
    stranger = Client(board, key=bytes(32))
    assert stranger.answer is None and "another key" in stranger.session.closed
    greeting = Decoder().feed(Session(board, KEY, 0.0).challenge(0.0))[0]
    assert authentic(greeting, challenge_key(KEY))
    assert not authentic(greeting, challenge_key(bytes(32)))


def test_a_frame_of_another_session_is_forged():
    board, _, client = armed()
    other = Session(board, KEY, 0.0, nonce=b"another nonce..."[:NONCE_SIZE])
    other.receive(client.frame(Kind.HELLO, bytes(NONCE_SIZE) + bytes([WRITER])), 0.0)
    assert "another key" in other.closed


def test_who_does_not_say_hello_is_put_out():
    session = Session(Board(settings(2), Still()), KEY, 0.0)
    session.tick(1.9)
    assert not session.closed
    session.tick(2.1)
    assert "hello" in session.closed


@pytest.mark.parametrize(
    ("disturb", "fault"),
    [
        (lambda v: setattr(v, "reading", lambda port, p: float("nan")), Fault.SENSOR),
        (lambda v: setattr(v, "reading", lambda port, p: 300 * kPa), Fault.SENSOR),
        (lambda v: setattr(v, "reading", lambda port, p: 75 * kPa), Fault.OVER_PRESSURE),
        (lambda v: setattr(v, "reading", lambda port, p: -25 * kPa), Fault.OVER_PRESSURE),
        (lambda v: v.stuck.add(1), Fault.TRACKING),
    ],
)
def test_what_the_sensors_tell_trips_the_board(disturb, fault):
    valves = BenchValves(2)
    board = Board(settings(2, low=-10 * kPa, high=60 * kPa), valves)
    client = Client(board)
    client.arm()
    disturb(valves)
    for now in np.arange(0.0, 1.5, TICK):
        client.set([50 * kPa] * 2, now)
        board.tick(now)
    assert (board.state, board.fault) == (State.FAULT, fault)
    run(board, 1.5, 2.5)
    assert abs(valves.pressure[0]) < 0.2 * kPa


def test_a_bus_that_fails_trips_the_board():
    board, valves, client = armed()
    client.set([5 * kPa] * 2, 0.0)

    def broken(pressures):
        raise OSError("no acknowledge")

    valves.write = broken
    board.tick(0.01)
    assert board.fault is Fault.BACKEND


def test_bench_valves_rise_without_overshoot():
    valves = BenchValves(1, noise=0.0)
    valves.write([50 * kPa])
    times = np.arange(0.0, 0.3, TICK)
    told = np.array([valves.read(now)[0] for now in times])
    # closed form of the second-order lag behind its dead time
    w, z, t = 2 * np.pi * 12, 0.9, np.maximum(times - 0.004, 0)
    wd = w * np.sqrt(1 - z**2)
    want = 50 * kPa * (1 - np.exp(-z * w * t) * (np.cos(wd * t) + z * w / wd * np.sin(wd * t)))
    assert np.max(np.abs(told - want)) < 1.0 * kPa
    assert abs(told[-1] - 50 * kPa) <= 1.5 * STEP
    # a command acts within the step of 0.5 ms in whose first half it arrives, or in the next
    for dead_time, moves in ((2e-4, True), (3e-4, False)):
        valves = BenchValves(1, noise=0.0, dead_time=dead_time)
        valves.read(0.0)
        valves.write([50 * kPa])
        valves.read(5e-4)
        assert (valves.pressure[0] > 0) == moves


def test_scales_of_the_platform():
    assert [dac_code(p * kPa) for p in (-100, 100, 1e6)] == [0, 4095, 4095]
    assert [pressure_of_command(u) for u in (0.0, 0.5, 1.0)] == [-100 * kPa, 0.0, 100 * kPa]
    assert [voltage_of_pressure(p * kPa) for p in (-100, 0, 100)] == [0.0, 5.0, 10.0]
    assert dac_pressure(1) - dac_pressure(0) == pytest.approx(48.84, abs=0.01)
    # 0x4E2 = 1250 steps of 2 mV: 2.5 V at the converter, 5 V at the sensor
    assert adc_pressure(bytes([0x4E, 0x20]), gain=2.0) == pytest.approx(0.0, abs=1e-9)
    assert adc_pressure(bytes([0xFF, 0xF0]), gain=2.0) == pytest.approx(-100.08 * kPa)
    assert adc_request(0) == bytes([0x01, 0xC3, 0xC3])


class FakeBus:
    """Converters on a wire: what the DAC was told is what the ADC reads."""

    def __init__(self, gain):
        self.codes, self.gain, self.asked = {}, gain, []

    def write(self, address, data):
        if address in (0x60, 0x61):
            self.codes[address - 0x60 + 0x48] = int.from_bytes(data, "big")
        elif len(data) == 3:
            self.asked.append((address, data))

    def read(self, address, count):
        pressure = dac_pressure(self.codes.get(address, 2048))
        steps = round(voltage_of_pressure(pressure) / self.gain / 2e-3)
        return (steps << 4).to_bytes(2, "big", signed=True)


def test_the_platform_reads_what_it_writes():
    gain = PLATFORM[0].gain
    buses = {wire.bus: FakeBus(gain) for wire in PLATFORM}
    valves = I2CValves(buses)
    asked = np.linspace(-90, 90, 12) * kPa
    valves.write(asked.tolist())
    step = 2e-3 * gain * 20e3  # of the converter
    assert np.max(np.abs(np.array(valves.read(0.0)) - asked)) <= step / 2 + 25
    with pytest.raises(ValueError, match="no bus \\[3, 4, 5, 6, 7\\]"):
        I2CValves({1: buses[1]})


def test_the_raw_stream_of_the_first_platform():
    valves = Still(2)
    board = Board(settings(2), valves)
    session = LegacySession(board, 0.0)
    data = struct.pack("<2d", 0.75, 0.5)
    answer = session.receive(data[:9], 0.0) + session.receive(data[9:] + b"\0\0\0", 0.0)
    assert struct.unpack("<2d", answer) == (5.0, 5.0)
    run(board, 0.0, 0.1)
    assert valves.pressure == [50 * kPa, 0.0]
    run(board, 0.1, 0.7)
    assert valves.pressure == [0.0, 0.0] and board.fault is Fault.WATCHDOG
    session.receive(data, 0.7)
    assert board.state is State.FAULT  # only a new connection arms again
    session.lost(0.8)
    LegacySession(board, 0.9).receive(data, 0.9)
    assert board.state is State.ARMED


@pytest.mark.stress(55)
@pytest.mark.parametrize(
    "wrong",
    [struct.pack("<2d", bad, 0.5) for bad in (np.nan, np.inf, 1.5, -1e300, 1e-300)]
    + [
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1:8888\r\nAccept: */*\r\n\r\n",
        b"GET /a? HTTP/1.1\r\nHost: localhost\r\nX: aaaaaa??aaaaaa??",  # numbers in [0, 1]
        b"aaaaaa??bbbbbb??" * 4,
        bytes.fromhex("16030100f8010000f40303") + bytes(range(64)),  # a hello of TLS
        b"SORO" + bytes(60),
    ],
)
def test_the_raw_stream_ends_at_the_first_message_that_is_no_commands(wrong):
    for before in (0, 1):
        valves = Still(2)
        board = Board(settings(2), valves)
        session = LegacySession(board, 0.0)
        good = struct.pack("<2d", 0.7, 0.6)
        answer = session.receive(before * good + wrong + 3 * good, 0.0)
        assert "no commands" in session.closed and len(answer) == before * len(good)
        assert board.state is (State.FAULT if before else State.VENTED) and board.owner is None
        assert session.receive(good, 0.001) == b""
        run(board, 0.0, 0.09)
        assert all(value == 0 for told in valves.told for value in told)


def test_the_raw_stream_follows_every_command_of_a_client():
    board = Board(settings(2), Still(2))
    session = LegacySession(board, 0.0)
    sweep = [0.0, 1.0, *(0.5 + 0.5 * np.sin(np.linspace(0, 20, 999)))]
    for k, u in enumerate(sweep):
        session.receive(struct.pack("<2d", u, 1 - u), 0.002 * k)
    assert not session.closed and board.refused == 0
    silent = LegacySession(board, 0.0)
    silent.receive(b"\0" * 9, 1.9)
    silent.tick(1.99)
    assert not silent.closed
    silent.tick(2.01)
    assert "in time" in silent.closed


@pytest.mark.stress(53)
def test_payloads_refuse_other_lengths():
    report = Board(settings(3), Still(3)).report()
    assert messages.unpack_report(messages.pack_report(report)) == report
    for unpack, size in (
        (lambda b: messages.unpack_set(b, 2), 13), (lambda b: messages.unpack_arm(b, 2), 15),
        (messages.unpack_welcome, 9), (messages.unpack_report, 20),
        (messages.unpack_refused, 4), (messages.unpack_refused, 5),
    ):  # fmt: skip
        with pytest.raises(messages.Malformed):
            unpack(bytes(size))
