"""The firmware's messages by chip, written out so that they can be checked against its dictionary."""

from __future__ import annotations

from typing import Any

DATA = "sensor_bulk_data oid=%c sequence=%hu data=%*s"
STATUS = (
    "sensor_bulk_status oid=%c clock=%u query_ticks=%u next_sequence=%hu buffered=%u possible_overflows=%hu"
)


def configure(mcu: Any, chip: str, oid: int, bus_oid: int, bus_type: Any, kind: Any) -> None:
    """Create the chip's object on the board, not reading. `kind`: which one of a family."""
    for name, text in (
        ("adxl345", f"config_adxl345 oid={oid} spi_oid={bus_oid}"),
        ("lis2dw", f"config_lis2dw oid={oid} bus_oid={bus_oid} bus_oid_type={bus_type} lis_chip_type={kind}"),
        ("mpu9250", f"config_mpu9250 oid={oid} i2c_oid={bus_oid}"),
        ("icm20948", f"config_icm20948 oid={oid} i2c_oid={bus_oid}"),
        ("bmi160", f"config_bmi160 oid={oid} bus_oid={bus_oid} bus_oid_type={bus_type}"),
    ):
        if name == chip:
            mcu.add_config_cmd(text)
    for name, text in (
        ("adxl345", f"query_adxl345 oid={oid} rest_ticks=0"),
        ("lis2dw", f"query_lis2dw oid={oid} rest_ticks=0"),
        ("mpu9250", f"query_mpu9250 oid={oid} rest_ticks=0"),
        ("icm20948", f"query_icm20948 oid={oid} rest_ticks=0"),
        ("bmi160", f"query_bmi160 oid={oid} rest_ticks=0"),
    ):
        if name == chip:
            mcu.add_config_cmd(text, on_restart=True)


def query(mcu: Any, chip: str, queue: Any) -> Any:
    """The command that starts and stops the reading."""
    for name, text in (
        ("adxl345", "query_adxl345 oid=%c rest_ticks=%u"),
        ("lis2dw", "query_lis2dw oid=%c rest_ticks=%u"),
        ("mpu9250", "query_mpu9250 oid=%c rest_ticks=%u"),
        ("icm20948", "query_icm20948 oid=%c rest_ticks=%u"),
        ("bmi160", "query_bmi160 oid=%c rest_ticks=%u"),
    ):
        if name == chip:
            return mcu.lookup_command(text, cq=queue)
    raise KeyError(chip)


def status(mcu: Any, chip: str, oid: int, queue: Any) -> Any:
    """The command that asks how far the reading is."""
    for name, text in (
        ("adxl345", "query_adxl345_status oid=%c"),
        ("lis2dw", "query_lis2dw_status oid=%c"),
        ("mpu9250", "query_mpu9250_status oid=%c"),
        ("icm20948", "query_icm20948_status oid=%c"),
        ("bmi160", "query_bmi160_status oid=%c"),
    ):
        if name == chip:
            return mcu.lookup_query_command(text, STATUS, oid=oid, cq=queue)
    raise KeyError(chip)
