"""Devices on the SPI and I2C buses of a micro-controller, for the modules that drive chips.

    MCU_SPI_from_config(config, mode)  options spi_speed, spi_bus, spi_software_{sclk,mosi,miso}_pin, chip select
    MCU_I2C_from_config(config)        options i2c_mcu, i2c_bus, i2c_address, i2c_speed, i2c_software_{scl,sda}_pin

Until the MCU is configured, data to send goes into its start-up commands (sent at each start); afterwards it goes out
at once, in the order of the device's own command queue.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper


def _hex(data: Sequence[int]) -> str:
    return bytes(data).hex()  # as configuration commands write bytes


def resolve_bus_name(mcu: Any, param: str, bus: str | None) -> str | int:
    """The bus to use, by the firmware's enumeration `param` ("spi_bus", "i2c_bus"); claims the bus's own pins.

    Without a name it is the firmware's number 0. Raises the printer's config_error for a name it does not have.
    """
    enumerations = mcu.get_enumerations()
    # SAMD boards have one enumeration for both kinds
    known: Mapping[str, int] = enumerations.get(param) or enumerations.get("bus", {})
    if not known:
        return 0 if bus is None else bus
    if bus is None:
        first = [name for name, number in known.items() if number == 0]
        if not first:
            raise mcu.get_printer().config_error(
                f"The board '{mcu.get_name()}' has several buses, none of them the default: set option '{param}'"
                f" to one of {', '.join(known)}."
            )
        bus = first[0]
    if bus not in known:
        raise mcu.get_printer().config_error(
            f"Unknown {param} '{bus}': the board '{mcu.get_name()}' has {', '.join(known)}."
        )
    pins = mcu.get_constants().get(f"BUS_PINS_{bus}")
    if pins is not None:
        resolver = mcu.get_printer().lookup_object("pins").get_pin_resolver(mcu.get_name())
        for pin in str(pins).split(","):
            resolver.reserve_pin(pin, bus)
    return bus


######################################################################
# SPI
######################################################################


@dataclass(frozen=True, slots=True)
class SpiPins:
    """The three lines of a bus made by software."""

    miso: str
    mosi: str
    sclk: str


class MCU_SPI:
    """One device on an SPI bus."""

    def __init__(
        self,
        mcu: Any,
        bus: str | None,
        pin: str | None,
        mode: int,
        speed: int,
        sw_pins: SpiPins | None = None,
        cs_active_high: bool = False,
    ) -> None:
        self.mcu = mcu
        self.bus = bus
        self.speed = speed
        self.mode = mode
        self.sw_pins = sw_pins
        self.oid = oid = mcu.create_oid()
        self.cmd_queue = mcu.alloc_command_queue()
        self._send: Any = None
        self._transfer: Any = None
        if pin is None:
            mcu.add_config_cmd(f"config_spi_without_cs oid={oid}")
        else:
            mcu.add_config_cmd(f"config_spi oid={oid} pin={pin} cs_active_high={int(cs_active_high)}")
        mcu.register_config_callback(self._build_config)

    def _build_config(self) -> None:
        mcu, oid = self.mcu, self.oid
        lines = self.sw_pins
        if lines is None:
            bus = resolve_bus_name(mcu, "spi_bus", self.bus)
            mcu.add_config_cmd(f"spi_set_bus oid={oid} spi_bus={bus} mode={self.mode} rate={self.speed}")
        else:
            half_ticks = mcu.seconds_to_clock(0.5 / self.speed)
            mcu.add_config_cmd(
                f"spi_set_sw_bus oid={oid} miso_pin={lines.miso} mosi_pin={lines.mosi} sclk_pin={lines.sclk}"
                f" mode={self.mode} pulse_ticks={half_ticks}"
            )
        self._send = mcu.lookup_command("spi_send oid=%c data=%*s", cq=self.cmd_queue)
        self._transfer = mcu.lookup_query_command(
            "spi_transfer oid=%c data=%*s",
            "spi_transfer_response oid=%c response=%*s",
            oid=oid,
            cq=self.cmd_queue,
        )

    def setup_shutdown_msg(self, shutdown_seq: Sequence[int]) -> None:
        """Bytes the firmware sends to the device when it shuts down."""
        shutdown_oid = self.mcu.create_oid()
        self.mcu.add_config_cmd(
            f"config_spi_shutdown oid={shutdown_oid} spi_oid={self.oid} shutdown_msg={_hex(shutdown_seq)}"
        )

    def get_oid(self) -> int:
        return self.oid

    def get_mcu(self) -> Any:
        return self.mcu

    def get_command_queue(self) -> Any:
        return self.cmd_queue

    def spi_send(self, data: Sequence[int], minclock: int = 0, reqclock: int = 0) -> None:
        """Send without an answer; before the MCU is configured: at each start."""
        if self._send is None:
            self.mcu.add_config_cmd(f"spi_send oid={self.oid} data={_hex(data)}", is_init=True)
            return
        self._send.send([self.oid, bytes(data)], minclock=minclock, reqclock=reqclock)

    def spi_transfer(self, data: Sequence[int], minclock: int = 0, reqclock: int = 0) -> dict[str, Any]:
        """Send, and wait for as many bytes; `response` of the result has them."""
        params: dict[str, Any] = self._transfer.send(
            [self.oid, bytes(data)], minclock=minclock, reqclock=reqclock
        )
        return params

    def spi_transfer_with_preface(
        self, preface_data: Sequence[int], data: Sequence[int], minclock: int = 0, reqclock: int = 0
    ) -> dict[str, Any]:
        """The same, with another message sent right before (again with each retry)."""
        params: dict[str, Any] = self._transfer.send_with_preface(
            self._send,
            [self.oid, bytes(preface_data)],
            [self.oid, bytes(data)],
            minclock=minclock,
            reqclock=reqclock,
        )
        return params


def _same_chip(config: ConfigWrapper, pins: Sequence[Mapping[str, Any]], mcu: Any) -> None:
    for params in pins:
        if params["chip"] is not mcu:
            raise config.error(
                f"Section '{config.get_name()}': all pins of a bus must be on the same board, {params['pin']} is not."
            )


def MCU_SPI_from_config(
    config: ConfigWrapper,
    mode: int,
    pin_option: str = "cs_pin",
    default_speed: int = 100000,
    share_type: str | None = None,
    cs_active_high: bool = False,
) -> MCU_SPI:
    """The device of a section, by its SPI options; `pin_option` names the chip select ("None": there is none)."""
    pins = config.get_printer().lookup_object("pins")
    cs_pin = config.get(pin_option)
    cs_params = pins.lookup_pin(cs_pin, share_type=share_type)
    pin = cs_params["pin"]
    if pin == "None":
        pins.reset_pin_sharing(cs_params)
        pin = None
    mcu = cs_params["chip"]
    speed = config.getint("spi_speed", default_speed, minval=100000)
    if config.get("spi_software_sclk_pin", None) is None:
        bus = config.get("spi_bus", None)
        return MCU_SPI(mcu, bus, pin, mode, speed, cs_active_high=cs_active_high)
    lines = [
        pins.lookup_pin(config.get(f"spi_software_{line}_pin"), share_type=f"spi_software_{line}_pin")
        for line in ("miso", "mosi", "sclk")
    ]
    _same_chip(config, lines, mcu)
    sw_pins = SpiPins(*(params["pin"] for params in lines))
    return MCU_SPI(mcu, None, pin, mode, speed, sw_pins, cs_active_high)


######################################################################
# I2C
######################################################################


@dataclass(frozen=True, slots=True)
class I2cPins:
    """The two lines of a bus made by software."""

    scl: str
    sda: str


class MCU_I2C:
    """One device on an I2C bus."""

    def __init__(
        self, mcu: Any, bus: str | None, addr: int, speed: int, sw_pins: I2cPins | None = None
    ) -> None:
        self.mcu = mcu
        self.bus = bus
        self.i2c_address = addr
        self.speed = speed
        self.sw_pins = sw_pins
        self.oid = mcu.create_oid()
        self.cmd_queue = mcu.alloc_command_queue()
        self._transfer: Any = None
        self._early: list[bytes] = []  # written before the MCU was configured
        mcu.add_config_cmd(f"config_i2c oid={self.oid}")
        mcu.register_config_callback(self._build_config)

    def _build_config(self) -> None:
        mcu, oid, address = self.mcu, self.oid, self.i2c_address
        lines = self.sw_pins
        if lines is None:
            bus = resolve_bus_name(mcu, "i2c_bus", self.bus)
            mcu.add_config_cmd(f"i2c_set_bus oid={oid} i2c_bus={bus} rate={self.speed} address={address}")
        else:
            half_ticks = mcu.seconds_to_clock(0.5 / self.speed)
            mcu.add_config_cmd(
                f"i2c_set_sw_bus oid={oid} scl_pin={lines.scl} sda_pin={lines.sda} pulse_ticks={half_ticks}"
                f" address={address}"
            )
        for data in self._early:
            mcu.add_config_cmd(f"i2c_transfer oid={oid} write={_hex(data)} read_len=0", is_init=True)
        self._transfer = mcu.lookup_query_command(
            "i2c_transfer oid=%c write=%*s read_len=%u",
            "i2c_response oid=%c i2c_bus_status=%c response=%*s",
            oid=oid,
            cq=self.cmd_queue,
        )

    def get_oid(self) -> int:
        return self.oid

    def get_mcu(self) -> Any:
        return self.mcu

    def get_i2c_address(self) -> int:
        return self.i2c_address

    def get_command_queue(self) -> Any:
        return self.cmd_queue

    def i2c_transfer(
        self,
        write: Sequence[int],
        read_len: int = 0,
        minclock: int = 0,
        reqclock: int = 0,
        retry: bool = True,
    ) -> dict[str, Any]:
        """Write, then read `read_len` bytes; they are in `response`. Raises the printer's command_error if the
        device does not answer."""
        params: dict[str, Any] = self._transfer.send(
            [self.oid, bytes(write), read_len], minclock=minclock, reqclock=reqclock, retry=retry
        )
        status = params["i2c_bus_status"]
        if status not in ("SUCCESS", 0):
            where = f"at address {self.i2c_address} on board '{self.mcu.get_name()}'"
            raise self.mcu.get_printer().command_error(
                f"I2C device {where} failed: {status}. Check its wiring and i2c_address."
            )
        return params

    def i2c_write(self, data: Sequence[int], minclock: int = 0, reqclock: int = 0) -> None:
        """Write; before the MCU is configured: at each start."""
        if self._transfer is None:
            self._early.append(bytes(data))
            return
        self.i2c_transfer(data, 0, minclock, reqclock)

    def i2c_read(self, write: Sequence[int], read_len: int, retry: bool = True) -> dict[str, Any]:
        """Write a register address, read `read_len` bytes."""
        return self.i2c_transfer(write, read_len, retry=retry)


def MCU_I2C_from_config(
    config: ConfigWrapper, default_addr: int | None = None, default_speed: int = 100000
) -> MCU_I2C:
    """The device of a section, by its I2C options."""
    printer = config.get_printer()
    name = config.get("i2c_mcu", "mcu")
    mcu = printer.lookup_object("mcu" if name == "mcu" else f"mcu {name}", None)
    if mcu is None:
        raise config.error(f"Section '{config.get_name()}': there is no [mcu {name}] (option 'i2c_mcu').")
    speed = config.getint("i2c_speed", default_speed, minval=100000)
    limits: dict[str, Any] = {"minval": 0, "maxval": 127}
    if default_addr is None:
        address = config.getint("i2c_address", **limits)
    else:
        address = config.getint("i2c_address", default_addr, **limits)
    if config.get("i2c_software_scl_pin", None) is None:
        return MCU_I2C(mcu, config.get("i2c_bus", None), address, speed)
    pins = printer.lookup_object("pins")
    lines = [
        pins.lookup_pin(config.get(f"i2c_software_{line}_pin"), share_type=f"i2c_software_{line}_pin")
        for line in ("scl", "sda")
    ]
    _same_chip(config, lines, mcu)
    return MCU_I2C(mcu, None, address, speed, I2cPins(*(params["pin"] for params in lines)))


######################################################################
# Outputs in step with a bus
######################################################################


class MCU_bus_digital_out:
    """A pin changed in the order of a bus's messages (a display's data/command line, for instance)."""

    def __init__(self, mcu: Any, pin_desc: str, cmd_queue: Any = None, value: int = 0) -> None:
        self.mcu = mcu
        self.oid = mcu.create_oid()
        pins = mcu.get_printer().lookup_object("pins")
        params = pins.lookup_pin(pin_desc)
        if params["chip"] is not mcu:
            raise pins.error(f"Pin {pin_desc} must be on board '{mcu.get_name()}', where its bus is.")
        self.cmd_queue = mcu.alloc_command_queue() if cmd_queue is None else cmd_queue
        self._update: Any = None
        level = int(bool(value))
        mcu.add_config_cmd(
            f"config_digital_out oid={self.oid} pin={params['pin']} value={level} default_value={level} max_duration=0"
        )
        mcu.register_config_callback(self._build_config)

    def _build_config(self) -> None:
        self._update = self.mcu.lookup_command("update_digital_out oid=%c value=%c", cq=self.cmd_queue)

    def get_oid(self) -> int:
        return self.oid

    def get_mcu(self) -> Any:
        return self.mcu

    def get_command_queue(self) -> Any:
        return self.cmd_queue

    def update_digital_out(self, value: int, minclock: int = 0, reqclock: int = 0) -> None:
        """Set the pin; before the MCU is configured: at each start."""
        level = int(bool(value))
        if self._update is None:
            self.mcu.add_config_cmd(f"update_digital_out oid={self.oid} value={level}", is_init=True)
            return
        self._update.send([self.oid, level], minclock=minclock, reqclock=reqclock)
