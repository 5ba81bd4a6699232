"""Status of printer objects for API clients: reading it, comparing it, and sending what has changed.

timer ─► StatusReader.collect (each object once) ─► difference to the round before ─► encoded once per kind of
subscription ─► Client.send_encoded
"""

from __future__ import annotations

import dataclasses
import json
import logging
from typing import Any, Protocol

END = b"\x03"  # of a message
_MISSING: Any = object()
_encode = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode


class Client(Protocol):
    """A receiver of messages."""

    def is_closed(self) -> bool: ...
    def send_encoded(self, data: bytes) -> None: ...


def encode(data: Any) -> bytes:
    """One message as sent."""
    try:
        text = _encode(data)
    except (TypeError, ValueError):
        text = _encode(_plain(data))
    return text.encode() + END


def _plain(value: Any) -> Any:
    """A copy JSON can express: unknown types as text, numbers that are none as null."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not -1e308 < value < 1e308:
        return None
    return value if isinstance(value, int | float | str | bool) or value is None else str(value)


Fields = tuple[str, ...] | None
Wanted = tuple[tuple[str, Fields], ...]  # objects with their fields (None: all)
Status = dict[str, dict[str, Any]]


@dataclasses.dataclass(slots=True)
class Subscription:
    """What one client wants; `seen`: the first status it was sent, until the next round."""

    wanted: Wanted
    template: dict[str, Any]
    key: str  # equal for those that are sent the same bytes
    period_s: float
    seen: Status | None


class StatusReader:
    """`get_status` of printer objects; an object that fails is reported once and has no status."""

    def __init__(self, printer: Any) -> None:
        self._printer = printer
        self._failed: set[str] = set()

    def names(self) -> list[str]:
        """All objects that have a status."""
        return [name for name, obj in self._printer.lookup_objects() if hasattr(obj, "get_status")]

    def read(self, name: str, eventtime: float) -> dict[str, Any] | None:
        """Status of one object; None if there is no such object."""
        found = self._printer.lookup_object(name, None)
        report = getattr(found, "get_status", None)
        if report is None:
            return None if found is None else {}
        try:
            return dict(report(eventtime))
        except Exception:
            if name not in self._failed:
                logging.exception("Error in the status of '%s' (reported once)", name)
                self._failed.add(name)
            return {}

    def collect(self, wanted: Wanted, eventtime: float, cache: Status) -> Status:
        """Status of several objects; a field that is not there is None, an object that is not there {}."""
        result: Status = {}
        for name, fields in wanted:
            if name not in cache:
                status = self.read(name, eventtime)
                if status is None:
                    result[name] = {}
                    continue
                cache[name] = status
            status = cache[name]
            result[name] = status if fields is None else {field: status.get(field) for field in fields}
        return result


class StatusPublisher:
    """Sends changes to all subscribers with one period.

    Each round is compared with the one before. For a new subscriber the first comparison is with what it was sent.
    """

    def __init__(self, reactor: Any, reader: StatusReader, period_s: float) -> None:
        self._reactor = reactor
        self._reader = reader
        self._period_s = period_s
        self._subscriptions: dict[Client, Subscription] = {}
        self._previous: Status = {}
        self._timer: Any = None

    def add(self, client: Client, subscription: Subscription) -> None:
        """From the next round on."""
        self._subscriptions[client] = subscription
        if self._timer is None:
            self._timer = self._reactor.register_timer(
                self._publish, self._reactor.monotonic() + self._period_s
            )

    def remove(self, client: Client) -> None:
        """Stop the timer."""
        self._subscriptions.pop(client, None)

    def _publish(self, eventtime: float) -> float:
        for client in [client for client in self._subscriptions if client.is_closed()]:
            del self._subscriptions[client]
        status: Status = {}
        changes: Status = {}  # of all fields since the previous round
        encoded: dict[str, bytes] = {}
        for client, subscription in list(self._subscriptions.items()):
            self._reader.collect(subscription.wanted, eventtime, status)
            if subscription.seen is not None:
                seen, subscription.seen = subscription.seen, None
                data = self._message(subscription, eventtime, _delta(status, seen, {}))
            else:
                if subscription.key not in encoded:
                    changes = _delta(status, self._previous, changes)
                    encoded[subscription.key] = self._message(subscription, eventtime, changes)
                data = encoded[subscription.key]
            if data:
                client.send_encoded(data)
        self._previous = status
        if not self._subscriptions:
            self._timer = None
            self._previous = {}
            return float(self._reactor.NEVER)
        return eventtime + self._period_s

    @staticmethod
    def _message(subscription: Subscription, eventtime: float, changes: Status) -> bytes:
        """Encoded update of one kind of subscription; empty if nothing it wants has changed."""
        mine: Status = {}
        for name, fields in subscription.wanted:
            delta = changes.get(name)
            if delta and fields is not None:
                delta = {field: delta[field] for field in fields if field in delta}
            if delta:
                mine[name] = delta
        if not mine:
            return b""
        return encode({**subscription.template, "params": {"eventtime": eventtime, "status": mine}})


def _delta(status: Status, before: Status, known: Status) -> Status:
    """Fields that differ from `before`, object by object; objects in `known` were compared already."""
    for name, fields in status.items():
        if name not in known:
            old = before.get(name, {})
            known[name] = {
                field: value for field, value in fields.items() if value != old.get(field, _MISSING)
            }
    return known
