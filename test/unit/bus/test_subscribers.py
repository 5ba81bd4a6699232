"""Clients of the API that want the samples of a sensor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from extras.accelerometer.bulk import Params, Subscribers


class Connection:
    """Of one client."""

    def __init__(self) -> None:
        self.messages: list[dict[str, Any]] = []
        self.closed = False

    def is_closed(self) -> bool:
        return self.closed

    def send(self, message: dict[str, Any]) -> None:
        self.messages.append(message)


class Request:
    """For one stream."""

    def __init__(self, connection: Connection, template: dict[str, Any]) -> None:
        self.connection, self.template = connection, template
        self.answer: Any = None

    def get_dict(self, name: str, default: Any) -> dict[str, Any]:
        return self.template

    def get_client_connection(self) -> Connection:
        return self.connection

    def send(self, answer: Any) -> None:
        self.answer = answer


class Source:
    """What Batches does with its clients."""

    def __init__(self) -> None:
        self.clients: list[Callable[[Params], bool]] = []
        self.subscribers = Subscribers(self.clients.append, lambda: bool(self.clients))

    def ask(self, connection: Connection, **template: Any) -> None:
        request = Request(connection, template)
        self.subscribers.serve(request, ["time"], lambda batch: {"rows": batch["data"]})
        assert request.answer == {"header": ["time"]}

    def batch(self) -> None:
        self.clients[:] = [client for client in self.clients if client({"data": [1]})]


def test_2000_subscriptions_of_one_client_are_one_message_for_a_batch() -> None:
    source, greedy, other = Source(), Connection(), Connection()
    for number in range(2000):
        source.ask(greedy, key=number)
    source.ask(other, key="b")
    source.batch()
    assert greedy.messages == [{"key": 1999, "params": {"rows": [1]}}]
    assert other.messages == [{"key": "b", "params": {"rows": [1]}}]


def test_a_client_that_has_gone_ends_the_stream_and_the_next_one_starts_it_again() -> None:
    source, connection = Source(), Connection()
    source.ask(connection)
    connection.closed = True
    source.batch()
    assert not source.clients
    after = Connection()
    source.ask(after)
    source.batch()
    assert len(after.messages) == 1 and not connection.messages


def test_after_a_fault_of_the_sensor_the_same_client_may_ask_again() -> None:
    source, connection = Source(), Connection()
    source.ask(connection)
    source.clients.clear()  # as Batches does
    source.ask(connection)
    source.batch()
    assert len(connection.messages) == 1
