"""Datagrams on their way: nothing is invented, the counts add up, and the same seed does the same."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_link import codec
from sim_link.codec import Encoder, frames, mavlink
from sim_link.datagram_faults import Channel, LinkFaults, message_number
from sim_link.fault_kinds import Fault, fault

TICK_US = 4_000
SHARES = st.floats(0.0, 1.0)
HOLDS = st.floats(1e-4, 0.1)
FAULTS = st.one_of(
    st.builds(lambda s: fault("loss", share=s), SHARES),
    st.builds(
        lambda g, b, m, lg, lb: fault("burst_loss", good_s=g, bad_s=b, bad_max_s=m, loss_good=lg, loss_bad=lb),
        *(HOLDS, HOLDS, HOLDS, SHARES, SHARES),
    ),
    st.builds(lambda d: fault("delay", delay_s=d), HOLDS),
    st.builds(lambda d: fault("jitter", jitter_s=d), HOLDS),
    st.builds(lambda s, d: fault("duplicate", share=s, late_s=d), SHARES, st.floats(0.0, 0.05)),
    st.builds(lambda s, d: fault("reorder", share=s, late_s=d), SHARES, HOLDS),
    st.builds(lambda s, b: fault("corrupt", share=s, bits=b), SHARES, st.integers(1, 64)),
)


def datagrams(count: int, msg_id: int = codec.ID_LOCAL_POSITION_NED) -> list[bytes]:
    """Frames that differ all from one another."""
    encoder = Encoder(1, 1)
    return [encoder.hot(msg_id, codec.LOCAL_POSITION_NED.pack(k + 1, *(0.5 * k,) * 6)) for k in range(count)]


def channel(*faults: Fault, seed: int = 1, name: str = "test") -> Channel:
    made = Channel(seed, name)
    for number, item in enumerate(faults):
        made.begin(number, item, 0)
    return made


def run(way: Channel, sent: list[bytes], per_tick: int = 2, drain: bool = True) -> list[tuple[int, bytes]]:
    """Give what comes out, and when: `per_tick` datagrams at each tick, then ticks until nothing is held."""
    out: list[tuple[int, bytes]] = []
    now_us = 0
    left = list(sent)
    while left or (drain and way.counts.held):
        now_us += TICK_US
        out += [(now_us, raw) for raw in way.released(now_us)]
        for raw in left[:per_tick]:
            out += [(now_us, passed) for passed in way.take(raw, now_us)]
        del left[:per_tick]
    return out


@settings(max_examples=60, deadline=None)
@given(st.lists(FAULTS, max_size=4), st.integers(0, 60), st.integers(1, 5), st.integers(0, 2**31))
def test_nothing_is_invented_and_the_counts_add_up(faults: list[Fault], count: int, per_tick: int, seed: int) -> None:
    sent = datagrams(count)
    way = channel(*faults, seed=seed)
    out = run(way, sent, per_tick)
    counts = way.counts
    assert counts.taken == count
    assert counts.held == 0
    assert counts.taken + counts.duplicated == counts.delivered + counts.lost
    assert counts.delivered == len(out)
    changed = {raw for _, raw in out if raw not in sent}
    assert len(changed) <= counts.corrupted
    assert {len(raw) for raw in changed} <= {len(raw) for raw in sent}
    times = [at for at, _ in out]
    assert times == sorted(times)
    if not any(f.kind == "duplicate" for f in faults):
        assert len(set(out)) == len(out)
    if not any(f.kind in ("duplicate", "reorder", "corrupt") for f in faults):
        order = [sent.index(raw) for _, raw in out]
        assert order == sorted(order)


@settings(max_examples=30, deadline=None)
@given(st.lists(FAULTS, min_size=1, max_size=3), st.integers(0, 2**31))
def test_the_same_seed_does_the_same(faults: list[Fault], seed: int) -> None:
    sent = datagrams(40)
    assert run(channel(*faults, seed=seed), sent) == run(channel(*faults, seed=seed), sent)


def test_another_seed_channel_or_number_does_something_else() -> None:
    sent = datagrams(200)
    half = fault("loss", share=0.5)
    first = run(channel(half), sent)
    assert first != run(channel(half, seed=2), sent)
    assert first != run(channel(half, name="other"), sent)
    other = Channel(1, "test")
    other.begin(7, half, 0)
    assert first != run(other, sent)


def test_a_datagram_more_changes_nothing_at_other_times() -> None:
    """So a wall clock that lets something come too much at one state does not change the rest of a flight."""
    sent = datagrams(200)
    way, more = channel(fault("loss", share=0.5)), channel(fault("loss", share=0.5))
    extra = datagrams(1)[0]
    for k, raw in enumerate(sent):
        now_us = TICK_US * (1 + k // 2)
        passed, also = way.take(raw, now_us), more.take(raw, now_us)
        if now_us > 8 * TICK_US:
            assert passed == also
        if k == 13:
            more.take(extra, now_us)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 1.0])
def test_the_share_that_is_lost(share: float) -> None:
    way = channel(fault("loss", share=share))
    run(way, datagrams(4000))
    sigma = math.sqrt(share * (1.0 - share) / 4000)
    assert way.counts.lost / 4000 == pytest.approx(share, abs=4.0 * sigma)


def test_bursts_have_their_lengths() -> None:
    """Gilbert-Elliott: the share of bad time is bad / (good + bad); in between nothing is lost."""
    way = channel(fault("burst_loss", good_s=0.3, bad_s=0.1))
    sent = datagrams(12_000)
    got = {raw for _, raw in run(way, sent, per_tick=1)}
    lost = [raw not in got for raw in sent]
    assert sum(lost) / len(lost) == pytest.approx(0.25, abs=0.05)
    lengths = [len(run_) for run_ in "".join("x" if gone else " " for gone in lost).split()]
    assert sum(lengths) / len(lengths) * TICK_US * 1e-6 == pytest.approx(0.1, rel=0.35)


def test_no_burst_is_longer_than_allowed() -> None:
    way = channel(fault("burst_loss", good_s=0.5, bad_s=1.0, bad_max_s=0.04))
    sent = datagrams(5000)
    got = {raw for _, raw in run(way, sent, per_tick=1)}
    bursts = "".join(" " if raw in got else "x" for raw in sent).split()
    assert max(map(len, bursts)) == 0.04e6 / TICK_US
    assert len(bursts) > 20


def test_a_delay_is_the_delay_in_vehicle_time_to_the_next_state() -> None:
    sent = datagrams(10)
    out = run(channel(fault("delay", delay_s=0.010)), sent, per_tick=1)
    assert out == [((k + 1 + 3) * TICK_US, raw) for k, raw in enumerate(sent)]


def test_the_order_is_kept_when_a_delay_ends() -> None:
    way = channel(fault("delay", delay_s=0.02))
    sent = datagrams(10)
    out: list[bytes] = []
    for k, raw in enumerate(sent):
        if k == 3:
            way.end(0)
        out += [*way.released(k * TICK_US), *way.take(raw, k * TICK_US)]
    assert out == sent[: len(out)]
    assert len(out) == 10 - way.counts.held


def test_reordered_datagrams_are_overtaken_and_none_is_missing() -> None:
    sent = datagrams(200)
    got = [raw for _, raw in run(channel(fault("reorder", share=0.2, late_s=0.02)), sent)]
    assert sorted(got) == sorted(sent)
    assert got != sent


def test_duplicates_come_late_if_asked_for() -> None:
    (raw,) = datagrams(1)
    out = run(channel(fault("duplicate", share=1.0, late_s=0.008)), [raw])
    assert out == [(TICK_US, raw), (3 * TICK_US, raw)]


@pytest.mark.parametrize("bits", [1, 8, 64])
def test_corruption_turns_that_many_bits_over(bits: int) -> None:
    (raw,) = datagrams(1)
    ((_, bad),) = run(channel(fault("corrupt", share=1.0, bits=bits)), [raw])
    assert sum((a ^ b).bit_count() for a, b in zip(raw, bad, strict=True)) == bits
    assert frames(bad) == []


def test_only_the_named_messages_are_met() -> None:
    way = channel(fault("silence", messages=["ODOMETRY"]), fault("delay", delay_s=0.02, messages=["TIMESYNC"]))
    position = datagrams(1)[0]
    encoder = Encoder(1, 1)
    odometry = encoder.hot(codec.ID_ODOMETRY, bytes(232) + b"\1")
    timesync = encoder.hot(codec.ID_TIMESYNC, codec.TIMESYNC.pack(1, 2, 0, 0))
    assert way.take(odometry, 0) == []
    assert way.take(timesync, 0) == []
    assert way.take(position, 0) == [position]
    assert way.released(20_000) == [timesync]


def test_forgetting_loses_what_is_under_way() -> None:
    way = channel(fault("delay", delay_s=1.0))
    for raw in datagrams(5):
        way.take(raw, 0)
    way.forget()
    assert way.released(10_000_000) == []
    assert (way.counts.lost, way.counts.held) == (5, 0)
    way.end(0)
    assert way.idle


def test_the_number_of_a_message_in_both_versions() -> None:
    message = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)
    mav = mavlink.MAVLink(None)
    assert message_number(message.pack(mav)) == 0
    assert message_number(Encoder(1, 1).hot(codec.ID_ODOMETRY, b"\1")) == codec.ID_ODOMETRY
    first = bytes((0xFE, 9, 0, 1, 1, 76, *range(9), 0, 0))
    assert message_number(first) == 76


# Links


def frame(raw: bytes) -> codec.Frame:
    return frames(raw)[0]


def test_the_lockstep_exchange_always_passes() -> None:
    link = LinkFaults(1, "companion", spares_exchange=True)
    link.begin(0, fault("silence", direction="both"))
    encoder = Encoder(1, 1)
    question = encoder.hot(codec.ID_TIMESYNC, codec.TIMESYNC.pack(0, 5_000, 0, 0))
    answer = frame(encoder.hot(codec.ID_TIMESYNC, codec.TIMESYNC.pack(9, 5_000, 0, 0)))
    other = datagrams(1)[0]
    outbox = [other, question]
    link.outgoing(outbox)
    assert outbox == [question]
    assert link.incoming([answer, frame(other)]) == [answer]
    # The companion's own requests, and the vehicle's answers to them, are datagrams like others.
    outbox = [answer.raw]
    link.outgoing(outbox)
    assert outbox == []
    assert link.incoming([frame(question)]) == []


def test_without_lockstep_nothing_is_spared_but_orders() -> None:
    link = LinkFaults(1, "companion")
    link.begin(0, fault("silence", direction="both"))
    encoder = Encoder(1, 1)
    outbox = [encoder.hot(codec.ID_TIMESYNC, codec.TIMESYNC.pack(0, 5_000, 0, 0))]
    link.outgoing(outbox)
    assert outbox == []
    order = frame(encoder.cold(mavlink.MAVLink_serial_control_message(10, 0, 0, 0, 2, list(b"a\n".ljust(70, b"\0")))))
    assert link.incoming([order]) == [order]


def test_a_fault_is_for_its_link_and_its_direction() -> None:
    raw = datagrams(1)[0]
    for name, way, heard, said in (
        ("companion", "to_vehicle", [], [raw]),
        ("both", "from_vehicle", [frame(raw)], []),
        ("ground", "both", [frame(raw)], [raw]),
    ):
        link = LinkFaults(1, "companion")
        link.begin(0, fault("loss", share=1.0, direction=way, link=name))
        outbox = [raw]
        link.outgoing(outbox)
        assert (link.incoming([frame(raw)]), outbox) == (heard, said)
        link.end(0)
        assert link.idle


def test_late_datagrams_go_out_and_in_with_later_states() -> None:
    link = LinkFaults(1, "companion")
    link.begin(0, fault("delay", delay_s=0.004))
    raw = datagrams(1)[0]
    outbox = [raw]
    link.outgoing(outbox)
    assert outbox == [] and link.incoming([frame(raw)]) == []
    link.end(0)
    assert not link.idle
    link.now_us = TICK_US
    link.outgoing(outbox)
    assert outbox == [raw]
    assert link.released() == [frame(raw)]
    assert link.idle


def test_what_is_corrupted_beyond_recognition_is_not_heard() -> None:
    link = LinkFaults(1, "companion")
    link.begin(0, fault("corrupt", share=1.0))
    heard = [heard for raw in datagrams(300) for heard in link.incoming([frame(raw)])]
    assert len(heard) <= 1, "the checksum of 16 bits finds nearly all"
