"""Gives a vehicle its sockets and its time: real time, a multiple of it, or lockstep with the companion.

Lockstep: after each state the vehicle asks with TIMESYNC (tc1 = 0, ts1 = its time), and its clock waits until the
answer with that ts1 has come. What came before the answer is acted on first, in order; what comes after it belongs to
the next state. Where a state tells nothing but the past, and nothing that the answer holds can change it, it goes out
as soon as the answer is seen, before the answer's setpoint is acted on. No wall clock enters the simulation, so that
the same seed and the same companion give the same flight to the byte.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from .codec import (
    ID_SERIAL_CONTROL,
    ID_TIMESYNC,
    TIMESYNC,
    Frame,
    attitude_target,
    exchange,
    lone_setpoint,
    timesync,
)
from .fault_shell import FaultShell
from .intake import Intake, allowance
from .link import Link
from .truth_log import TruthLog
from .udp import Address, UdpEndpoint
from .vehicle import Vehicle
from .waiting import Waiter

PATIENCE_S = 1.0
"""Wall time that the clock waits for a companion's answer; then it runs on at real time until one answers again."""
HEARTBEAT_WALL_S = 0.2
"""Between heartbeats while the clock stands still and waits for the first companion."""
SLICE_S = 0.1
"""Longest single wait, so that a stop is noticed."""
_SPIN_S = 2.0e-4
"""Wall time for which an answer is polled for before the process sleeps: waking up takes longer than most answers."""
_SPIN_NEXT_S = 3.0e-5
"""The same once something of the companion has come: the rest follows closely."""
_SPIN_REST_MAX = 127
"""States for which it sleeps at once after polling was in vain time and again: the companion needs the processor."""
_AT_ONCE = 64
"""Of the companion's datagrams so many are acted on in lockstep before the clock and `stopped` are looked at."""
_LATE_MAX_S = 0.25
"""Of lateness so much is caught up with; the rest is let go."""


@dataclass(frozen=True)
class PeerOptions:
    """Ports and time."""

    port: int
    """Companion link, local; 0: any free one."""
    remote_port: int
    """Companion link, spoken to first; 0: nobody until somebody speaks."""
    ground_port: int | None = None
    """Ground link, local; None: there is none."""
    ground_remote_port: int = 14550
    truth_port: int | None = None
    """Where the truth goes; None: nowhere."""
    lockstep: bool = False
    speed: float = 1.0
    """Vehicle time per wall time, without lockstep."""


def _never() -> bool:
    return False


def _silent(sentence: str) -> None:
    """Tell nobody."""


class Peer:
    """Runs one vehicle on real sockets, in the calling thread."""

    def __init__(
        self,
        vehicle: Vehicle,
        options: PeerOptions,
        *,
        stopped: Callable[[], bool] = _never,
        notice: Callable[[str], None] = _silent,
        waiter: Waiter | None = None,
        sharers: int = 1,
    ) -> None:
        """Open the sockets.

        Args:
            vehicle: what to run.
            options: ports and time.
            stopped: asked often; once it says yes, `run` returns.
            notice: gets a sentence when the companion falls silent in lockstep, when it is back, and when a fault
                begins or ends.
            waiter: where the sockets register; None: one of its own.
            sharers: vehicles that share the thread (see `fleet`), and with it what is heard per state.

        Raises:
            PortError: a port is in use.
        """
        self.vehicle = vehicle
        self.options = options
        self.companion = UdpEndpoint(options.port, options.remote_port, "--port")
        self.companion.together = options.lockstep
        self.ground: UdpEndpoint | None = None
        self._truth: UdpEndpoint | None = None
        try:
            if options.ground_port is not None:
                self.ground = UdpEndpoint(options.ground_port, options.ground_remote_port, "--ground-port")
            if options.truth_port is not None:
                self._truth = UdpEndpoint(0, options.truth_port, "--truth-port")
        except OSError:
            self.companion.close()
            if self.ground is not None:
                self.ground.close()
            raise
        self.synchronous = options.lockstep
        """Whether the clock waits for the companion; False while a silent one lets it run at real time."""
        vehicle.asks_time = not options.lockstep
        vehicle.tells_truth = options.truth_port is not None
        vehicle.faults.tell = notice
        if options.lockstep:
            vehicle.faults.effects.set_lockstep()
        self._shell = FaultShell(vehicle.faults, vehicle.system)
        self._truth_log: TruthLog | None = None
        self._stopped = stopped
        self._notice = notice
        self._endpoints = [self.companion] if self.ground is None else [self.companion, self.ground]
        self._waiter = Waiter() if waiter is None else waiter
        self.state_wall_s = vehicle.period_us * 1e-6 / (1.0 if options.lockstep else options.speed)
        """Wall time between two states, while no companion moves the clock."""
        per_state = allowance(self.state_wall_s, sharers)
        self._intakes = [Intake(endpoint, self._waiter, per_state) for endpoint in self._endpoints]
        self._waiting: deque[tuple[list[Frame], Address]] = deque()
        self._spin_vain = 0
        """States for which sleeping at once is the better choice, when polling was in vain last."""
        self._spin_rest = 0
        """How many of them are left."""
        self._awaited_ns = self._ahead_ns = -1
        """Which states' answer is waited for, and which state went out ahead of its time last [ns]."""
        self._last_us: int | None = None
        self._answered = False
        self._started = not options.lockstep
        self._deadline_s = time.monotonic()
        self._is_late = False
        """Whether the time of the next state was over already when the present one came."""
        self._ticked_s = self._deadline_s

    def log_truth(self, log: TruthLog) -> None:
        """Write a row for now and for every state to come; `close` completes the file."""
        log.add(log.row(self.vehicle.airframe))
        self._truth_log = log

    def run(self, duration_s: float | None = None) -> None:
        """Run until told to stop, or for a time of the vehicle's."""
        self._last_us = end_us = None if duration_s is None else self.vehicle.start_us + round(duration_s * 1e6)
        physics = self.vehicle.airframe  # its time goes on through a reboot
        if not self._started and not self._wait_for_companion():
            return
        self._deadline_s = time.monotonic()
        while not self._stopped() and (end_us is None or physics.t_us < end_us):
            self.step()

    def step(self) -> None:
        """Advance by one state: move, send, then wait as the kind of time asks, acting on what is received."""
        text = self._advance()
        over = True
        if self.synchronous:
            over = self._wait_for_answer()
        else:
            self._wait_for_time()
        if over:
            self._log_row(text)

    def _advance(self) -> str:
        """Move by one state period and send; gives the state's row for the truth file, if there is one."""
        vehicle = self.vehicle
        vehicle.tick(self._send_state)
        if vehicle.truth_outbox:
            self._flush()
        if vehicle.companion.faults is not None or vehicle.ground.faults is not None:
            for link in vehicle.links:
                if link.faults is not None:
                    for frame in link.faults.released():
                        self._obey(frame, link)
        # The companion is at work now: what else there is to do costs nobody any time.
        vehicle.look_ahead()
        self._refill()
        return "" if self._truth_log is None else self._truth_log.row(vehicle.airframe)

    def _log_row(self, text: str) -> None:
        """Write a row of the truth file."""
        if self._truth_log is not None:
            self._truth_log.add(text)

    def _send_state(self, t_us: int) -> None:
        """Send the messages of a state; in lockstep ask for the companion's answer to it."""
        if self.options.lockstep:
            self._awaited_ns = t_us * 1000
            self._answered = False
            ahead_ns, self._ahead_ns = self._ahead_ns, -1
            if ahead_ns == self._awaited_ns:  # it is out already
                return
            self.vehicle.companion.send_hot(ID_TIMESYNC, TIMESYNC.pack(0, self._awaited_ns, 0, 0))
        self._ticked_s = time.monotonic()
        self._flush()

    def close(self) -> None:
        """Close the sockets and complete the truth file."""
        for endpoint in (*self._endpoints, self._truth):
            if endpoint is not None:
                endpoint.close()
        if self._truth_log is not None:
            self._truth_log.close()
        self.vehicle.faults.close()

    # Waiting

    def _wait_for_companion(self) -> bool:
        """Stand still until a companion's first message is here, which counts after the first state. False: stopped."""
        next_heartbeat_s = time.monotonic()
        while not self._stopped():
            now_s = time.monotonic()
            if now_s >= next_heartbeat_s:
                next_heartbeat_s = now_s + HEARTBEAT_WALL_S
                self.vehicle.heartbeat()
                self._flush()
            timeout_s = max(0.0, min(SLICE_S, next_heartbeat_s - now_s))
            if self._waiter.wait(timeout_s) and self._hear_first():
                return True
        return False

    def _hear_first(self) -> bool:
        """Take the companion's first message, which counts after the first state. False: there is none yet."""
        self._refill()
        self._hear_ground()
        datagram = self.companion.receive()
        if datagram is None or not datagram[0]:
            return False
        if datagram[0][0].msg_id == ID_SERIAL_CONTROL:
            self._act(*datagram)
            return False
        for frame in datagram[0]:
            self.vehicle.companion.signing.learn_time(frame)  # or the first state would come from the past
        self._waiting.append(datagram)
        self._started = True
        return True

    def _wait_for_answer(self) -> bool:
        """Act on what comes until the companion has answered this state, for a bounded time. False: stopped before.

        A state that was never answered is left out of the truth file, so that the file does not depend on when exactly
        the companion ended the vehicle.
        """
        while self._waiting and not self._answered:
            self._act(*self._waiting.popleft())
        give_up_s = self._ticked_s + PATIENCE_S
        self._spin_first()
        if self._answered and self.ground is not None:
            self._hear_ground()  # nobody has slept, and so nobody has looked there
        while not self._answered:
            left_s = give_up_s - time.monotonic()
            if left_s <= 0.0:
                self._lose_patience()
                break
            stopped = self._stopped()
            self._serve(0.0 if stopped else min(left_s, SLICE_S))
            if stopped and not self._answered:
                return False
            self._spin(_SPIN_NEXT_S)
        self._flush()
        return True

    def _spin_first(self) -> None:
        """Poll for the answer to the present state, unless that was in vain for the states before."""
        if self._answered:
            return
        if self._spin_rest > 0:
            self._spin_rest -= 1
            return
        self._spin(_SPIN_S)
        self._spin_vain = 0 if self._answered else min(2 * self._spin_vain + 1, _SPIN_REST_MAX)
        self._spin_rest = self._spin_vain

    def _spin(self, limit_s: float) -> None:
        """Poll for the answer for a time; each datagram extends it a little, but never beyond the patience."""
        take, clock = self.companion.take, time.monotonic
        end_s = clock() + limit_s
        give_up_s = self._ticked_s + PATIENCE_S
        while not self._answered:
            datagram = take()
            if datagram is not None:
                self._act_on(*datagram)
                now_s = clock()
                end_s = min(max(end_s, now_s + _SPIN_NEXT_S), give_up_s)
            else:
                now_s = clock()
            if now_s > end_s:
                return

    def _act_on(self, datagram: bytes, sender: Address) -> None:
        """Act on a datagram of the companion while its answer is waited for.

        Where it is a setpoint and the answer to the present state, the next state goes out before the setpoint is acted
        on: the companion can go on at once then; the stream is the same as without.
        """
        link, usual = self.vehicle.companion, exchange(datagram)
        mine = usual is not None and usual[1] == self._awaited_ns and sender == self.companion.partner
        if (
            usual is None
            or not mine
            or self._waiting
            or link.faults is not None
            or self.vehicle.keyring.key is not None
        ):
            self._act(*self.companion.read(datagram, sender))
            return
        if self._last_us is None or self.vehicle.airframe.t_us < self._last_us:
            foretold = self.vehicle.tell_ahead()
            if foretold is not None:
                self.companion.send(foretold.frames)
                self._ticked_s = time.monotonic()
                self._ahead_ns = foretold.t_us * 1000
        self.vehicle.autopilot.attitude_target(attitude_target(usual[0]))
        self._answered = True

    def _wait_for_time(self) -> None:
        """Act on what comes until the wall clock has caught up with the vehicle's."""
        self._set_deadline()
        if self.vehicle.companion.outbox or self.vehicle.ground.outbox:  # what the state's own datagrams had not yet
            self._flush()
        has_listened = False  # which it does at least once, however late it is
        while True:
            left_s = self._deadline_s - time.monotonic()
            if (left_s <= 0.0 and has_listened) or self._stopped():
                return
            self._serve(min(left_s, SLICE_S))
            self._flush()
            if self._answered:
                self._return_to_lockstep()
                return
            has_listened = True

    def _set_deadline(self) -> None:
        """Set the time of the next state; lateness beyond a limit is let go."""
        self._deadline_s += self.state_wall_s
        now_s = time.monotonic()
        self._is_late = now_s > self._deadline_s
        if now_s - self._deadline_s > _LATE_MAX_S:
            self._deadline_s = now_s

    def _lose_patience(self) -> None:
        """Let the clock run without the companion."""
        self.synchronous = False
        self._deadline_s = time.monotonic()
        self._notice(f"no answer from the companion for {PATIENCE_S:g} s: going on at real time")

    def _return_to_lockstep(self) -> None:
        """Let the clock wait for the companion again; what it has sent after its answer belongs to the next state."""
        self.synchronous = True
        left = self._intakes[0].take_pending()
        if left is not None:
            self._waiting.append(left)
        self._notice("the companion answers again: back in lockstep")

    def _serve(self, timeout_s: float) -> None:
        """Wait until something is received, and act on it."""
        for descriptor in self._waiter.wait(timeout_s):
            if descriptor == self.companion.descriptor:
                self._hear_companion()
            else:
                self._hear_ground()

    # Receiving and sending

    def _refill(self) -> None:
        """Let every socket be heard anew: a new state has begun."""
        for intake in self._intakes:
            intake.refill()

    def _hear_companion(self) -> None:
        """Act on what the companion has sent: in lockstep up to its answer, else as far as the allowance goes."""
        if self.synchronous:
            self._hear_until_answer()
            return
        intake, link = self._intakes[0], self.vehicle.companion
        while not (self._answered and self.options.lockstep):
            heard = intake.next(link.faults, self._obeyed, once=not self._is_late)
            if heard is None:
                break
            intake.left -= self._take(*heard)
        intake.rest()

    def _obeyed(self, datagram: bytes) -> bool:
        """Act on a datagram that is a setpoint of the companion and nothing else; False: it is another one.

        What happens to all others happens to it as well, at a fraction of the price: there is one for every state.
        """
        vehicle = self.vehicle
        if self.companion.partner is None or vehicle.companion.faults is not None or vehicle.keyring.key is not None:
            return False
        payload = lone_setpoint(datagram)
        if payload is not None:
            vehicle.autopilot.attitude_target(attitude_target(payload))
        return payload is not None

    def _hear_until_answer(self) -> None:
        """Act on the companion's datagrams, but none beyond its answer: those belong to the next state."""
        for _ in range(_AT_ONCE):
            datagram = None if self._answered else self.companion.take()
            if datagram is None:
                return
            self._act_on(*datagram)

    def _act(self, found: list[Frame], sender: Address) -> None:
        """Act on the messages of one datagram of the companion."""
        link = self.vehicle.companion
        for frame in found if link.faults is None else link.faults.incoming(found):
            self._take(frame, sender)

    def _take(self, frame: Frame, sender: Address) -> int:
        """Act on a message of the companion; gives how many answer it."""
        link = self.vehicle.companion
        if frame.msg_id == ID_SERIAL_CONTROL:
            answers = self._shell.take(frame, sender)
            self.companion.answer(answers, sender)
            return len(answers)
        if not link.signing.accepts(frame):
            return 0
        queued = len(link.outbox)
        if frame.msg_id == ID_TIMESYNC:
            self._timesync(frame, link, sender == self.companion.partner)
        else:
            self.vehicle.receive(frame, link)
        return len(link.outbox) - queued

    def _hear_ground(self) -> None:
        """Act on what the ground link has received, as far as the allowance goes."""
        if self.ground is None:
            return
        intake, link = self._intakes[1], self.vehicle.ground
        while (heard := intake.next(link.faults)) is not None:
            frame, sender = heard
            if frame.msg_id == ID_SERIAL_CONTROL:
                answers = self._shell.take(frame, sender)
                self.ground.answer(answers, sender)
                intake.left -= len(answers)
                continue
            queued = len(link.outbox)
            self._obey(frame, link)
            intake.left -= len(link.outbox) - queued
        intake.rest()

    def _obey(self, frame: Frame, link: Link) -> None:
        """Act on a message that is neither an order of faults nor part of the lockstep exchange."""
        if not link.signing.accepts(frame):
            return
        link.speak()
        if frame.msg_id == ID_TIMESYNC:
            self.vehicle.forget_foretold()
            self._timesync(frame, link, False)
        else:
            self.vehicle.receive(frame, link)

    def _timesync(self, frame: Frame, link: Link, from_companion: bool) -> None:
        """Answer a request; take an answer to ours as the end of a lockstep exchange."""
        tc1, ts1 = timesync(frame.payload)
        if tc1 == 0:
            wrong_ns = 0 if link.faults is None else link.faults.answer_offset_ns
            link.send_hot(ID_TIMESYNC, TIMESYNC.pack(self._now_ns() + wrong_ns, ts1, frame.system, frame.component))
            return
        # While running free, any answer shows that the companion is back.
        wanted = ts1 == self._awaited_ns or (not self.synchronous and 0 < ts1 <= self._awaited_ns)
        if wanted and from_companion and self.options.lockstep:
            self._answered = True

    def _now_ns(self) -> int:
        """Give the vehicle's time; between two states it follows the wall clock, but not in lockstep."""
        now_ns = self.vehicle.t_us * 1000
        if self.options.lockstep:
            return now_ns
        since_ns = round((time.monotonic() - self._ticked_s) * self.options.speed * 1e9)
        return now_ns + min(max(since_ns, 0), self.vehicle.period_us * 1000)

    def _flush(self) -> None:
        """Send what waits in the outboxes."""
        vehicle = self.vehicle
        companion, ground = vehicle.companion, vehicle.ground
        if companion.faults is not None or ground.faults is not None:
            for link in vehicle.links:
                if link.faults is not None:
                    link.faults.outgoing(link.outbox)
            self.companion.together = False  # what is wrong with one frame must not reach another
        if companion.outbox:
            self.companion.send(companion.outbox)
        if ground.outbox:
            if self.ground is not None:
                self.ground.send(ground.outbox)
            else:
                ground.outbox.clear()
        if vehicle.truth_outbox:
            if self._truth is not None:
                self._truth.send(vehicle.truth_outbox)
            else:
                vehicle.truth_outbox.clear()
