"""The firmware's messages by family of converters, written out so that they can be checked against its dictionary."""

from __future__ import annotations

from typing import Any

from ..accelerometer.messages import STATUS


def query(mcu: Any, family: str, queue: Any) -> Any:
    """The command that starts and stops the reading."""
    for name, text in (
        ("hx71x", "query_hx71x oid=%c rest_ticks=%u"),
        ("ads1220", "query_ads1220 oid=%c rest_ticks=%u"),
        ("ads131m0x", "query_ads131m0x oid=%c rest_ticks=%u"),
    ):
        if name == family:
            return mcu.lookup_command(text, cq=queue)
    raise KeyError(family)


def status(mcu: Any, family: str, oid: int, queue: Any) -> Any:
    """The command that asks how far the reading is."""
    for name, text in (
        ("hx71x", "query_hx71x_status oid=%c"),
        ("ads1220", "query_ads1220_status oid=%c"),
        ("ads131m0x", "query_ads131m0x_status oid=%c"),
    ):
        if name == family:
            return mcu.lookup_query_command(text, STATUS, oid=oid, cq=queue)
    raise KeyError(family)


def stop_at_restart(mcu: Any, family: str, oid: int) -> None:
    """After a restart of the host alone the last session's reading ends."""
    for name, text in (
        ("hx71x", f"query_hx71x oid={oid} rest_ticks=0"),
        ("ads1220", f"query_ads1220 oid={oid} rest_ticks=0"),
        ("ads131m0x", f"query_ads131m0x oid={oid} rest_ticks=0"),
    ):
        if name == family:
            mcu.add_config_cmd(text, on_restart=True)


def attach_trigger(mcu: Any, family: str, oid: int, trigger_oid: int) -> None:
    """The trigger sees the samples; both objects must be there already."""
    for name, text in (
        ("hx71x", f"hx71x_attach_trigger_analog oid={oid} trigger_analog_oid={trigger_oid}"),
        ("ads1220", f"ads1220_attach_trigger_analog oid={oid} trigger_analog_oid={trigger_oid}"),
        ("ads131m0x", f"ads131m0x_attach_trigger_analog oid={oid} trigger_analog_oid={trigger_oid}"),
    ):
        if name == family:
            mcu.add_config_cmd(text)
