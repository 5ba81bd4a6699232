"""Event loop of the host: timers, file descriptors and cooperative greenlets on an injected clock.

Theory of operation
-------------------
Exactly one greenlet, the one holding *the baton*, runs the dispatch loop and calls timer and file descriptor
callbacks as plain function calls. A callback that wants to sleep (`pause`) parks its greenlet in a wake timer
and passes the baton to a spare greenlet, which goes on dispatching:

      worker A: loop -> callback -> pause ....................(parked)............. resumes -> loop
                                      | baton                                          ^ baton
      worker B:                       +-> loop -> callback ... -> A's wake timer fires-+   (B is now spare)

So callbacks that never sleep cost no greenlet switch at all, and those that do cost two.

Time is an argument (see `TimeSource`): the loop never reads a clock or sleeps on its own. Simulated runs hand in
a source that advances a simulated world; everything else in the host is unaware of it.

Order is deterministic: due timers run by (wake time, order of scheduling). A wake time in the past counts as
"now", so a timer that always asks for NOW takes turns with everything else that is due.
"""

from __future__ import annotations

import collections
import heapq
import os
import select
import time
from collections.abc import Callable
from threading import Thread
from typing import Any, Protocol

import greenlet

EventCallback = Callable[[float], Any]

_NOW = 0.0
_NEVER = 9999999999999999.0
# A timer that asks for a moment nearer than this gets it so much later: less than the clock resolves is the same one,
# and virtual time, which waits for timers, would stand.
_STEP_MIN_S = 1e-6
_NEW_WORKER = object()  # asked of the greenlet in run()
_COMPACT_MARGIN = 256  # stale heap entries tolerated before the heap is rebuilt


class FdPoll:
    """The set of watched file descriptors; a `TimeSource` polls it while it waits."""

    def __init__(self) -> None:
        self._poll = select.poll()
        self._handlers: dict[int, ReactorFileHandler] = {}
        self._ready: list[tuple[int, int]] = []
        self.woken = False  # the reactor has written to its own pipe

    def watch(self, handler: ReactorFileHandler) -> None:
        """Start watching, or change what is watched for."""
        mask = (select.POLLIN | select.POLLHUP if handler.want_read else 0) | (
            select.POLLOUT if handler.want_write else 0
        )
        self._handlers[handler.fd] = handler
        self._poll.register(handler.fd, mask)

    def forget(self, handler: ReactorFileHandler) -> None:
        """Stop watching; an event already collected for it is dropped."""
        if self._handlers.get(handler.fd) is handler:
            del self._handlers[handler.fd]
            self._poll.unregister(handler.fd)
            self._ready = [(fd, mask) for fd, mask in self._ready if fd != handler.fd]

    def poll(self, timeout_s: float) -> bool:
        """Collect ready descriptors, waiting at most `timeout_s`; True if there are any."""
        if not self._ready:
            if timeout_s <= 0.0 and not self.woken and len(self._handlers) == 1:
                return False  # only the pipe is watched, and nothing is in it
            self._ready = self._poll.poll(max(0.0, timeout_s) * 1000.0)
        return bool(self._ready)

    @property
    def count(self) -> int:
        """Number of watched descriptors (the reactor's own wake-up pipe included)."""
        return len(self._handlers)

    def dispatch(self, eventtime: float) -> None:
        """Call the handlers of all collected descriptors."""
        while self._ready:
            fd, mask = self._ready.pop(0)
            handler = self._handlers.get(fd)
            if handler is None:
                continue
            if handler.want_read and mask & (
                select.POLLIN | select.POLLHUP | select.POLLERR | select.POLLNVAL
            ):
                handler.read_callback(eventtime)
            if handler.want_write and handler.write_callback is not None and mask & select.POLLOUT:
                handler.write_callback(eventtime)


class TimeSource(Protocol):
    """Where time comes from. The reactor calls `wait` whenever it has run all timers that are due."""

    runs_by_itself: bool  # False: time stands still while the host computes, as in a simulation

    def monotonic(self) -> float:
        """Now, in seconds."""
        ...

    def wait(self, until: float, poll: FdPoll) -> None:
        """Return at `until` (may be past already), or sooner if a descriptor or the outside world has something."""
        ...


class SystemTime:
    """The real clock of this computer."""

    LONGEST_WAIT_S = 1000.0
    runs_by_itself = True

    def __init__(self) -> None:
        self.monotonic: Callable[[], float] = time.monotonic

    def wait(self, until: float, poll: FdPoll) -> None:
        """Sleep in poll(2)."""
        poll.poll(min(until - time.monotonic(), self.LONGEST_WAIT_S))


class ReactorTimer:
    """Handle of a registered timer.

    `ticket` is its place in the order of timers, 0 when not scheduled; `entry` the number of its heap entry. The two
    differ after the timer was moved to a later time: the entry is moved when it comes to the top.
    """

    __slots__ = ("callback", "due", "entry", "ticket", "waketime")

    def __init__(self, callback: EventCallback) -> None:
        self.callback = callback
        self.waketime = self.due = _NEVER
        self.ticket = self.entry = 0


class ReactorFileHandler:
    """Handle of a watched file descriptor. Callbacks that sleep may be entered again: hand long work to a timer."""

    __slots__ = ("fd", "read_callback", "want_read", "want_write", "write_callback")

    def __init__(self, fd: int, read_callback: EventCallback, write_callback: EventCallback | None) -> None:
        self.fd = fd
        self.read_callback = read_callback
        self.write_callback = write_callback
        self.want_read, self.want_write = True, False

    def fileno(self) -> int:
        return self.fd


class _Worker(greenlet.greenlet):
    """A greenlet able to hold the baton, with the timer that wakes it."""

    wake: ReactorTimer


class ReactorCompletion:
    """A value that becomes known later; any number of greenlets may wait for it."""

    _PENDING: Any = object()

    def __init__(self, reactor: Reactor) -> None:
        self._reactor = reactor
        self._result: Any = self._PENDING
        self._sleepers: list[ReactorTimer] = []

    def test(self) -> bool:
        """True once completed."""
        return self._result is not self._PENDING

    def complete(self, result: Any) -> None:
        """Set the value and wake all waiting (reactor thread only; others use `async_complete`)."""
        self._result = result
        for sleeper in self._sleepers:
            self._reactor.update_timer(sleeper, _NOW)

    def wait(self, waketime: float = _NEVER, waketime_result: Any = None) -> Any:
        """Sleep until completed; at `waketime` give up and return `waketime_result`."""
        if self._result is self._PENDING:
            sleeper = self._reactor.sleeper()
            self._sleepers.append(sleeper)
            try:
                self._reactor.pause(waketime)
            finally:
                self._sleepers.remove(sleeper)
        return waketime_result if self._result is self._PENDING else self._result


class ReactorMutex:
    """First come, first served lock between greenlets."""

    def __init__(self, reactor: Reactor, is_locked: bool) -> None:
        self._reactor = reactor
        self._locked = is_locked
        self._queue: collections.deque[ReactorTimer] = collections.deque()
        self._heir: ReactorTimer | None = None
        self._owner: greenlet.greenlet | None = None

    def test(self) -> bool:
        """True while the lock is held."""
        return self._locked

    def contended(self) -> bool:
        """True while another greenlet waits for the lock."""
        return bool(self._queue)

    def is_mine(self) -> bool:
        """True if the running greenlet holds the lock."""
        return self._owner is greenlet.getcurrent()

    def lock(self) -> None:
        """Take the lock, sleeping until it is free."""
        if not self._locked:
            self._locked = True
            self._owner = greenlet.getcurrent()
            return
        me = self._reactor.sleeper()
        self._queue.append(me)
        while self._heir is not me:
            self._reactor.pause(_NEVER)
        self._heir = None
        self._owner = greenlet.getcurrent()

    def unlock(self) -> None:
        """Give the lock to the first in the queue, if any."""
        self._owner = None
        if not self._queue:
            self._locked = False
            return
        self._heir = self._queue.popleft()
        self._reactor.update_timer(self._heir, _NOW)

    def __enter__(self) -> ReactorMutex:
        self.lock()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.unlock()


class Reactor:
    """Timers, descriptors and sleeping greenlets of one host run. All methods but the `async` ones: reactor thread."""

    NOW = _NOW
    NEVER = _NEVER

    def __init__(self, time_source: TimeSource | None = None) -> None:
        self.time_source: TimeSource = SystemTime() if time_source is None else time_source
        self.monotonic: Callable[[], float] = self.time_source.monotonic
        self._heap: list[tuple[float, int, ReactorTimer]] = []
        self._live = 0
        self._tickets = 0
        self.late_s = 0.0  # maximum delay of a timer since somebody put 0 here
        self._pass_time = 0.0  # no timer is filed under an earlier time: keeps "now" fair
        self._running = False
        self._fds = FdPoll()
        self._main: greenlet.greenlet | None = None
        self._spare: list[_Worker] = []
        self._workers: list[_Worker] = []
        self._async_calls: collections.deque[Callable[[], None]] = collections.deque()
        self._pipe: tuple[int, int] | None = None
        self._open_pipe()

    # --- timers ---
    def register_timer(self, callback: EventCallback, waketime: float = _NEVER) -> ReactorTimer:
        """Call `callback(eventtime)` at `waketime`; it returns when it wants to be called next (None: unchanged)."""
        timer = ReactorTimer(callback)
        self.update_timer(timer, waketime)
        return timer

    def update_timer(self, timer_handler: ReactorTimer, waketime: float) -> None:
        """Move a timer. From inside its own callback the callback's return value wins."""
        was_due = timer_handler.due if timer_handler.ticket else _NEVER
        timer_handler.waketime = waketime
        if waketime >= _NEVER:
            if timer_handler.ticket:
                timer_handler.ticket = timer_handler.entry = 0
                self._live -= 1
            return
        if waketime < self._pass_time:
            waketime = self._pass_time
        self._tickets = ticket = self._tickets + 1
        timer_handler.due = waketime
        if timer_handler.ticket and waketime >= was_due:
            timer_handler.ticket = ticket
            return
        if not timer_handler.ticket:
            self._live += 1
        timer_handler.ticket = timer_handler.entry = ticket
        heapq.heappush(self._heap, (waketime, ticket, timer_handler))
        if len(self._heap) > 2 * self._live + _COMPACT_MARGIN:
            self._heap[:] = [entry for entry in self._heap if entry[2].entry == entry[1]]
            heapq.heapify(self._heap)

    def unregister_timer(self, timer_handler: ReactorTimer) -> None:
        """Remove the timer."""
        self.update_timer(timer_handler, _NEVER)
        timer_handler.callback = _return_never

    def register_callback(self, callback: EventCallback, waketime: float = _NOW) -> ReactorCompletion:
        """Call `callback(eventtime)` once; its return value completes the returned completion."""
        completion = ReactorCompletion(self)

        def once(eventtime: float) -> float:
            completion.complete(callback(eventtime))
            return _NEVER

        self.register_timer(once, waketime)
        return completion

    # --- from other threads ---
    def register_async_callback(self, callback: EventCallback, waketime: float = _NOW) -> None:
        """As `register_callback`, from any thread."""
        self._async_calls.append(lambda: void(self.register_callback(callback, waketime)))
        self._wake_up()

    def async_complete(self, completion: ReactorCompletion, result: Any) -> None:
        """As `completion.complete(result)`, from any thread."""
        self._async_calls.append(lambda: completion.complete(result))
        self._wake_up()

    def run_beside(self, work: Callable[[], Any]) -> ReactorCompletion:
        """Do long `work` without blocking the host; completes with its result, or with its exception.

        `work` runs on a thread of its own and must not touch the printer. Where time stands still while the host
        computes it is done at once, so that a simulation repeats itself to the byte.
        """
        completion = self.completion()

        def attempt() -> Any:
            try:
                return work()
            except Exception as error:  # passed to the greenlet that waits for the result
                return error

        if self.time_source.runs_by_itself:
            Thread(target=lambda: self.async_complete(completion, attempt()), daemon=True).start()
        else:
            result = attempt()
            self.register_callback(lambda eventtime: completion.complete(result))
        return completion

    def _wake_up(self) -> None:
        pipe = self._pipe
        if pipe is not None:
            self._fds.woken = True
            try:
                os.write(pipe[1], b".")
            except (BlockingIOError, OSError):
                pass  # a full pipe wakes as well; a closed one means the reactor is gone

    def _open_pipe(self) -> None:
        read_fd, write_fd = os.pipe()
        os.set_blocking(read_fd, False)
        os.set_blocking(write_fd, False)
        self._pipe = (read_fd, write_fd)
        self.register_fd(read_fd, self._drain_pipe)

    def _drain_pipe(self, eventtime: float) -> None:
        assert self._pipe is not None
        self._fds.woken = False
        try:
            os.read(self._pipe[0], 4096)
        except BlockingIOError:
            pass

    def _run_async_calls(self) -> None:
        while self._async_calls:
            self._async_calls.popleft()()

    # --- descriptors ---
    def register_fd(
        self, fd: int, read_callback: EventCallback, write_callback: EventCallback | None = None
    ) -> ReactorFileHandler:
        """Call `read_callback(eventtime)` whenever `fd` is readable (or broken)."""
        handler = ReactorFileHandler(fd, read_callback, write_callback)
        self._fds.watch(handler)
        return handler

    def set_fd_wake(
        self, file_handler: ReactorFileHandler, is_readable: bool = True, is_writeable: bool = False
    ) -> None:
        """Choose which events of a descriptor are wanted."""
        file_handler.want_read, file_handler.want_write = is_readable, is_writeable
        self._fds.watch(file_handler)

    def unregister_fd(self, file_handler: ReactorFileHandler) -> None:
        """Stop watching (call before closing the descriptor)."""
        self._fds.forget(file_handler)
        # its owner holds the handler, and these hold the owner: freed at once rather than by the next collection
        file_handler.read_callback, file_handler.write_callback = _return_never, None

    # --- greenlets ---
    def completion(self) -> ReactorCompletion:
        """A new, pending completion."""
        return ReactorCompletion(self)

    def mutex(self, is_locked: bool = False) -> ReactorMutex:
        """A new lock."""
        return ReactorMutex(self, is_locked)

    def sleeper(self) -> ReactorTimer:
        """The wake timer of the running greenlet (a dummy outside the dispatch loop)."""
        current = greenlet.getcurrent()
        return current.wake if isinstance(current, _Worker) else ReactorTimer(_return_never)

    def pause(self, waketime: float) -> float:
        """Let everything else run until `waketime`; returns the time then (s)."""
        current = greenlet.getcurrent()
        if not isinstance(current, _Worker):
            return self._pause_outside(waketime)
        self.update_timer(current.wake, waketime)
        # a greenlet begins at the stack depth of whoever starts it: many that sleep would reach the limit
        assert self._main is not None
        result: float = self._spare.pop().switch() if self._spare else self._main.switch(_NEW_WORKER)
        return result

    def _pause_outside(self, waketime: float) -> float:
        """Before run() or after its end nothing can be dispatched: only time passes."""
        if waketime >= _NEVER:
            raise RuntimeError("reactor: endless pause outside of the dispatch loop")
        while self.monotonic() < waketime:
            self.time_source.wait(waketime, self._fds)
        return self.monotonic()

    def _new_worker(self) -> _Worker:
        worker = _Worker(self._dispatch_loop, parent=self._main)

        def wake(eventtime: float) -> None:
            holder = greenlet.getcurrent()
            assert isinstance(holder, _Worker)
            self._spare.append(holder)
            worker.switch(eventtime)

        worker.wake = ReactorTimer(wake)
        self._workers.append(worker)
        return worker

    # --- the loop ---
    def _dispatch_loop(self, *ignored: object) -> None:
        heap = self._heap
        wait, poll, monotonic = self.time_source.wait, self._fds, self.monotonic
        while self._running:
            while heap and heap[0][2].ticket != heap[0][1]:
                self._settle_top()  # moved or stopped since: nothing to wake up for
            due = heap[0][0] if heap else _NEVER
            wait(due, poll)
            self._pass_time = now = monotonic()
            if now > due + self.late_s:
                self.late_s = now - due
            if self._async_calls:
                self._run_async_calls()
            if poll._ready:
                poll.dispatch(now)
            last_ticket = self._tickets
            while heap and self._running:
                waketime, ticket, timer = heap[0]
                if timer.ticket != ticket:
                    self._settle_top()
                    continue
                if waketime > now or ticket > last_ticket:
                    break
                heapq.heappop(heap)
                self._fire(timer, now)

    def _settle_top(self) -> None:
        """The top of the heap is no longer its timer's place in order: move it there, or drop it."""
        _, ticket, timer = self._heap[0]
        if timer.entry == ticket:
            timer.entry = timer.ticket
            heapq.heapreplace(self._heap, (timer.due, timer.ticket, timer))
        else:
            heapq.heappop(self._heap)

    def _fire(self, timer: ReactorTimer, now: float) -> None:
        timer.ticket = timer.entry = 0
        timer.waketime = _NEVER
        self._live -= 1
        waketime = timer.callback(now)
        if waketime is None:  # a wake timer may have been set again by the greenlet it woke
            return
        if now <= waketime < now + _STEP_MIN_S:
            waketime = now + _STEP_MIN_S
        if timer.ticket or waketime < _NEVER:
            self.update_timer(timer, waketime)

    def run(self) -> None:
        """Dispatch until `end()`; an exception of a callback ends the loop and comes out here."""
        self._main = greenlet.getcurrent()
        self._running = True
        try:
            worker = self._spare.pop() if self._spare else self._new_worker()
            worker.parent = self._main
            while worker.switch() is _NEW_WORKER:
                worker = self._new_worker()
        finally:
            self._running = False

    def end(self) -> None:
        """Make `run` return after the running callback."""
        self._running = False

    def finalize(self) -> None:
        """Throw away sleeping greenlets and close the wake-up pipe; the reactor is not usable afterwards."""
        self._running = False
        for worker in self._workers:
            if worker and not worker.dead:
                worker.parent = greenlet.getcurrent()
                worker.throw()
        self._workers.clear()
        self._spare.clear()
        self._heap.clear()
        if self._pipe is not None:
            pipe, self._pipe = self._pipe, None
            os.close(pipe[0])
            os.close(pipe[1])


def void(_value: object) -> None:
    """Discard a value (lets a lambda call something for its effect)."""


def _return_never(eventtime: float) -> float:
    return _NEVER
