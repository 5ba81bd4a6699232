"""The event loop: order, pausing, waking, descriptors, other threads."""

from __future__ import annotations

import os
import threading
import time
from typing import Any

import pytest

from base_rig import VirtualTime
from reactor import Reactor, SystemTime


def run_for(reactor: Reactor, duration_s: float) -> None:
    reactor.register_callback(lambda eventtime: reactor.end(), reactor.monotonic() + duration_s)
    reactor.run()


def test_timers_run_in_order_of_time_then_of_registration() -> None:
    reactor = Reactor(VirtualTime())
    seen: list[str] = []
    for name, when in (("b", 101.0), ("c", 101.0), ("a", 100.5), ("d", 101.0)):
        reactor.register_callback(lambda eventtime, name=name: seen.append(name), when)
    run_for(reactor, 5.0)
    assert seen == ["a", "b", "c", "d"]


def test_returned_time_is_when_a_timer_runs_again() -> None:
    reactor = Reactor(VirtualTime(0.0))
    times: list[float] = []

    def tick(eventtime: float) -> float:
        times.append(eventtime)
        return eventtime + 0.25

    reactor.register_timer(tick, 1.0)
    run_for(reactor, 2.1)
    assert times == [1.0, 1.25, 1.5, 1.75, 2.0]


def test_a_timer_that_is_always_due_does_not_starve_others() -> None:
    reactor = Reactor(VirtualTime())
    greedy_runs = [0]

    def greedy(eventtime: float) -> float:
        greedy_runs[0] += 1
        assert greedy_runs[0] < 100, "the other timer never ran"
        return reactor.NOW

    reactor.register_timer(greedy, reactor.NOW)
    reactor.register_callback(lambda eventtime: reactor.end(), reactor.NOW)
    reactor.run()
    assert greedy_runs[0] >= 1


@pytest.mark.parametrize("ahead_s", [0.0, 1e-15, 1e-9])
def test_a_timer_that_is_almost_due_lets_virtual_time_pass(ahead_s: float) -> None:
    """Less than the clock resolves is the same moment, and what waits for a moment a little later waited for ever."""
    reactor = Reactor(VirtualTime(301.8031249999983))
    due_s, runs = reactor.monotonic() + 1e-5, [0]

    def almost(eventtime: float) -> float:
        runs[0] += 1
        assert runs[0] < 100, "virtual time stands"
        return eventtime + ahead_s if eventtime < due_s else reactor.NEVER

    reactor.register_timer(almost, reactor.NOW)
    run_for(reactor, 1.0)
    assert runs[0] > 2


def test_pause_lets_others_run_and_returns_the_time() -> None:
    reactor = Reactor(VirtualTime(0.0))
    seen: list[tuple[str, float]] = []

    def sleeper(eventtime: float) -> None:
        for _ in range(3):
            seen.append(("sleeper", reactor.pause(reactor.monotonic() + 1.0)))

    reactor.register_callback(sleeper)
    reactor.register_callback(lambda eventtime: seen.append(("other", eventtime)), 1.5)
    run_for(reactor, 10.0)
    assert seen == [("sleeper", 1.0), ("other", 1.5), ("sleeper", 2.0), ("sleeper", 3.0)]


def test_unregistered_and_moved_timers() -> None:
    reactor = Reactor(VirtualTime(0.0))
    seen: list[str] = []

    def note(name: str):  # type: ignore[no-untyped-def]
        def callback(eventtime: float) -> float:
            seen.append(name)
            return reactor.NEVER

        return callback

    gone = reactor.register_timer(note("gone"), 1.0)
    late = reactor.register_timer(note("late"), 1.0)
    early = reactor.register_timer(note("early"), 9.0)
    reactor.unregister_timer(gone)
    reactor.update_timer(late, 3.0)
    reactor.update_timer(early, 2.0)
    run_for(reactor, 20.0)
    assert seen == ["early", "late"]


def test_often_moved_timers_do_not_stack_up() -> None:
    reactor = Reactor(VirtualTime())
    timer = reactor.register_timer(lambda eventtime: reactor.NEVER)
    for i in range(10000):
        reactor.update_timer(timer, 1000.0 + i)
    assert len(reactor._heap) < 1000  # one live entry and a bounded number of stale ones


def test_a_timer_that_was_moved_wakes_nobody_at_its_old_time() -> None:
    class Watched(VirtualTime):
        waits = 0

        def wait(self, until: float, poll: Any) -> None:
            self.waits += 1
            super().wait(until, poll)

    source = Watched(0.0)
    reactor = Reactor(source)
    pushed = reactor.register_timer(lambda eventtime: reactor.NEVER, 0.005)

    def push(eventtime: float) -> float:
        reactor.update_timer(pushed, eventtime + 0.005)  # always before it is due
        return eventtime + 0.003

    reactor.register_timer(push, 0.0)
    run_for(reactor, 0.3)
    assert source.waits == pytest.approx(100, abs=4)


def test_completion_gives_its_value_to_all_waiting() -> None:
    reactor = Reactor(VirtualTime(0.0))
    completion = reactor.completion()
    got: list[tuple[float, object]] = []
    for _ in range(2):
        reactor.register_callback(lambda eventtime: got.append((0.0, completion.wait())))
    reactor.register_callback(lambda eventtime: completion.complete("value"), 2.0)
    run_for(reactor, 5.0)
    assert [value for _, value in got] == ["value", "value"]
    assert completion.test()
    assert completion.wait() == "value"


def test_completion_wait_gives_up_in_time() -> None:
    reactor = Reactor(VirtualTime(0.0))
    got: list[tuple[float, object]] = []
    reactor.register_callback(
        lambda eventtime: got.append((reactor.monotonic(), reactor.completion().wait(3.0, "late")))
    )
    run_for(reactor, 5.0)
    assert [value for _, value in got] == ["late"]


def test_callback_result_completes_its_completion() -> None:
    reactor = Reactor(VirtualTime(0.0))
    got: list[object] = []

    def asker(eventtime: float) -> None:
        got.append(reactor.register_callback(lambda at: at * 2, 1.5).wait())

    reactor.register_callback(asker)
    run_for(reactor, 5.0)
    assert got == [3.0]


def test_mutex_is_first_come_first_served() -> None:
    reactor = Reactor(VirtualTime(0.0))
    mutex = reactor.mutex()
    seen: list[str] = []

    def worker(name: str) -> None:
        with mutex:
            assert mutex.is_mine()
            seen.append(name + " in")
            reactor.pause(reactor.monotonic() + 1.0)
            seen.append(name + " out")

    for name in ("a", "b", "c"):
        reactor.register_callback(lambda eventtime, name=name: worker(name))
    reactor.register_callback(lambda eventtime: seen.append(f"contended {mutex.contended()}"), 0.5)
    run_for(reactor, 10.0)
    assert seen == ["a in", "contended True", "a out", "b in", "b out", "c in", "c out"]
    assert not mutex.test()


def test_an_exception_in_a_callback_comes_out_of_run() -> None:
    reactor = Reactor(VirtualTime())

    def bad(eventtime: float) -> None:
        reactor.pause(eventtime + 1.0)
        raise KeyError("broken")

    reactor.register_callback(bad)
    with pytest.raises(KeyError, match="broken"):
        reactor.run()


def test_finalize_ends_sleeping_greenlets() -> None:
    reactor = Reactor(VirtualTime(0.0))
    ended: list[bool] = []

    def sleeper(eventtime: float) -> None:
        try:
            reactor.pause(reactor.NEVER)
        finally:
            ended.append(True)

    reactor.register_callback(sleeper)
    run_for(reactor, 1.0)
    assert not ended
    reactor.finalize()
    assert ended == [True]


def test_descriptor_callbacks() -> None:
    reactor = Reactor(SystemTime())
    read_fd, write_fd = os.pipe()
    got: list[bytes] = []

    def readable(eventtime: float) -> None:
        got.append(os.read(read_fd, 100))
        reactor.end()

    handle = reactor.register_fd(read_fd, readable)
    reactor.register_callback(lambda eventtime: os.write(write_fd, b"hello"), reactor.monotonic() + 0.02)
    reactor.register_callback(lambda eventtime: reactor.end(), reactor.monotonic() + 5.0)
    reactor.run()
    reactor.unregister_fd(handle)
    assert got == [b"hello"]
    for fd in (read_fd, write_fd):
        os.close(fd)


def test_another_thread_wakes_the_loop_at_once() -> None:
    reactor = Reactor(SystemTime())
    completion = reactor.completion()
    started_s = time.monotonic()

    def ending(eventtime: float) -> None:
        assert completion.wait(reactor.monotonic() + 5.0, "timeout") == 42
        reactor.end()

    def other_thread() -> None:
        time.sleep(0.05)
        reactor.async_complete(completion, 42)

    reactor.register_callback(ending)
    thread = threading.Thread(target=other_thread)
    thread.start()
    reactor.run()
    thread.join()
    assert time.monotonic() - started_s < 2.0  # far below the 5 s a missed wake-up would take


def test_async_callbacks_run_even_if_time_is_simulated() -> None:
    reactor = Reactor(VirtualTime())
    seen: list[float] = []
    reactor.register_async_callback(seen.append)
    run_for(reactor, 1.0)
    assert len(seen) == 1


def test_timer_dispatch_is_cheap() -> None:
    reactor = Reactor(VirtualTime())
    left = [20000]

    def tick(eventtime: float) -> float:
        left[0] -= 1
        if not left[0]:
            reactor.end()
        return eventtime + 0.001

    reactor.register_timer(tick, reactor.NOW)
    started_s = time.process_time()
    reactor.run()
    per_timer_us = (time.process_time() - started_s) / 20000 * 1e6
    assert per_timer_us < 20.0  # about 2 us measured; the margin is for a busy test machine


@pytest.mark.parametrize("time_source", [None, VirtualTime()], ids=["wall clock", "virtual"])
def test_long_work_beside_gives_its_result_or_its_exception(time_source: Any) -> None:
    reactor = Reactor(time_source)
    got: list[Any] = []

    def asker(eventtime: float) -> None:
        got.append(reactor.run_beside(lambda: 6 * 7).wait())
        got.append(reactor.run_beside(lambda: 1 // 0).wait())
        got.append(reactor.monotonic() - eventtime)
        reactor.end()

    reactor.register_callback(asker)
    reactor.run()
    assert got[0] == 42
    assert isinstance(got[1], ZeroDivisionError)
    assert time_source is None or got[2] == 0.0  # virtual time stands still meanwhile


def test_the_loop_goes_on_while_work_is_done_beside_it() -> None:
    reactor = Reactor()
    ticked, finished = threading.Event(), []

    def asker(eventtime: float) -> None:
        finished.append(reactor.run_beside(lambda: ticked.wait(10.0)).wait())  # ends only if timers run
        reactor.end()

    reactor.register_callback(asker)
    reactor.register_callback(lambda eventtime: ticked.set(), reactor.monotonic() + 0.001)
    reactor.run()
    assert finished == [True]


def test_thousands_of_greenlets_may_sleep() -> None:
    """Each script of an API client that waits is one. A greenlet must not begin as deep as the one before."""
    reactor = Reactor(VirtualTime())
    woken: list[float] = []
    for _ in range(3000):
        reactor.register_callback(lambda eventtime: woken.append(reactor.pause(eventtime + 10.0)))
    run_for(reactor, 11.0)
    assert len(woken) == 3000
    reactor.finalize()
