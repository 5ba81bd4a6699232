"""Names of pins: `[^~][!][MCU:]PIN`, aliases and reservations of each chip, and who uses which pin."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any, NoReturn


class PinError(Exception):
    """A pin is described wrongly or used twice; the text is for the user."""


error = PinError

_DESCRIPTION = re.compile(r"(?P<mods>[\^~!\s]*)(?:(?P<chip>[^:\s^~!]+)\s*:)?\s*(?P<pin>[^:\s^~!]+)\s*")
_PIN_ARGUMENT = re.compile(r"(?P<key>[ _]pin=)(?P<name>\S+)")


@dataclass(slots=True)
class PinResolver:
    """Aliases and reserved pins of one chip."""

    chip_name: str = ""
    validate_aliases: bool = True
    reserved: dict[str, str] = field(default_factory=dict)
    aliases: dict[str, str] = field(default_factory=dict)
    active_pins: dict[str, str] = field(default_factory=dict)

    def reserve_pin(self, pin: str, reserve_name: str) -> None:
        """Forbid the use of a pin, because `reserve_name` needs it."""
        holder = self.reserved.get(pin, reserve_name)
        if holder != reserve_name:
            raise PinError(f"Pin {pin} is reserved for {holder}, {reserve_name} can not reserve it too.")
        self.reserved[pin] = reserve_name

    def alias_pin(self, alias: str, pin: str) -> None:
        """Give a pin a second name."""
        if self.aliases.get(alias, pin) != pin:
            raise PinError(f"Alias {alias} is mapped to pin {self.aliases[alias]}, it can not also be {pin}.")
        if re.search(r"[\s^~!:]", pin + alias) or not pin or not alias:
            raise PinError(f"Invalid pin alias '{alias}={pin}'.")
        target = self.aliases.get(pin, pin)
        self.aliases[alias] = target
        for other, mapped in self.aliases.items():
            if mapped == alias:
                self.aliases[other] = target

    def resolve(self, name: str) -> str:
        """The chip's own name of a pin; raises for a reserved pin."""
        pin = self.aliases.get(name, name)
        if pin in self.reserved:
            raise PinError(
                f"Pin {name} of {self.chip_name or 'the mcu'} is reserved for {self.reserved[pin]}."
            )
        known_as = self.active_pins.setdefault(pin, name)
        if self.validate_aliases and known_as != name:
            raise PinError(
                f"Pin {pin} of {self.chip_name or 'the mcu'} is used under two names, {known_as} and {name}."
            )
        return pin

    def update_command(self, cmd: str) -> str:
        """An MCU config command with `pin=NAME` resolved."""
        return _PIN_ARGUMENT.sub(lambda found: found["key"] + self.resolve(found["name"]), cmd)


class PrinterPins:
    """The object `pins`."""

    error = PinError

    def __init__(self, printer: Any = None) -> None:
        self._printer = printer
        self.chips: dict[str, Any] = {}
        self.active_pins: dict[str, dict[str, Any]] = {}
        self._resolvers: dict[str, PinResolver] = {}
        self._multi_use: set[tuple[str, str]] = set()  # chip, pin

    def register_chip(self, chip_name: str, chip: Any) -> None:
        """Make a chip's pins available as `chip_name:PIN`; `chip.setup_pin(type, params)` makes the objects."""
        if chip_name in self.chips:
            raise PinError(f"Chip '{chip_name}' is defined twice.")
        self.chips[chip_name] = chip
        self._resolvers[chip_name] = PinResolver(chip_name)

    def get_pin_resolver(self, chip_name: str) -> PinResolver:
        """Aliases and reservations of a chip."""
        if chip_name not in self._resolvers:
            raise PinError(f"Unknown chip name '{chip_name}'{self._known_chips()}.")
        return self._resolvers[chip_name]

    def parse_pin(self, pin_desc: str, can_invert: bool = False, can_pullup: bool = False) -> dict[str, Any]:
        """Chip, pin and modifiers of a description, without claiming the pin."""
        found = _DESCRIPTION.fullmatch(pin_desc.strip())
        mods = "".join(found["mods"].split()) if found else ""
        pullup = {"^": 1, "~": -1}.get(mods[:1], 0)
        invert = mods[abs(pullup) :]
        if found is None or invert not in ("", "!"):
            self._malformed(pin_desc, can_invert, can_pullup)
        if (pullup and not can_pullup) or (invert and not can_invert):
            self._malformed(pin_desc, can_invert, can_pullup)
        chip_name = found["chip"] or "mcu"
        if chip_name not in self.chips:
            where = self._sections_using(pin_desc)
            raise PinError(
                f"Unknown pin chip name '{chip_name}' in pin '{pin_desc}'{where}{self._known_chips()}."
            )
        return {
            "chip": self.chips[chip_name],
            "chip_name": chip_name,
            "pin": found["pin"],
            "share_type": None,
            "invert": int(bool(invert)),
            "pullup": pullup,
        }

    def lookup_pin(
        self, pin_desc: str, can_invert: bool = False, can_pullup: bool = False, share_type: str | None = None
    ) -> dict[str, Any]:
        """Claim a pin. Two claims of one pin need the same `share_type`, polarity and pull-up."""
        params = self.parse_pin(pin_desc, can_invert, can_pullup)
        params["share_type"] = share_type
        resolver = self._resolvers[params["chip_name"]]
        own_name = resolver.aliases.get(params["pin"], params["pin"])
        key = f"{params['chip_name']}:{own_name}"
        holder = self.active_pins.get(key)
        if holder is None:
            self.active_pins[key] = params
            return params
        if any(
            name == params["chip_name"] and resolver.aliases.get(pin, pin) == own_name
            for name, pin in self._multi_use
        ):
            return params
        if share_type is None or share_type != holder["share_type"]:
            raise PinError(
                f"Pin {params['pin']} is used multiple times in the config{self._sections_using(pin_desc)}."
            )
        if any(params[name] != holder[name] for name in ("invert", "pullup")):
            raise PinError(
                f"Shared pin {params['pin']} must have the same polarity and pull-up everywhere"
                f"{self._sections_using(pin_desc)}."
            )
        return holder

    def setup_pin(self, pin_type: str, pin_desc: str) -> Any:
        """Claim a pin and make the chip's object for it (`endstop digital_out pwm adc`)."""
        can_invert = pin_type in ("endstop", "digital_out", "pwm")
        params = self.lookup_pin(pin_desc, can_invert, pin_type == "endstop")
        return params["chip"].setup_pin(pin_type, params)

    def reset_pin_sharing(self, pin_params: dict[str, Any]) -> None:
        """Forget the claim of a pin."""
        resolver = self._resolvers[pin_params["chip_name"]]
        own_name = resolver.aliases.get(pin_params["pin"], pin_params["pin"])
        self.active_pins.pop(f"{pin_params['chip_name']}:{own_name}", None)

    def allow_multi_use_pin(self, pin_desc: str) -> None:
        """Allow a pin to be claimed by several ([duplicate_pin_override]); its chip may be unknown yet."""
        found = _DESCRIPTION.fullmatch(pin_desc.strip())
        if found is None or found["mods"].strip():
            self._malformed(pin_desc, False, False)
        self._multi_use.add((found["chip"] or "mcu", found["pin"]))

    # --- messages ---
    def _malformed(self, pin_desc: str, can_invert: bool, can_pullup: bool) -> NoReturn:
        prefix = ("[^~] " if can_pullup else "") + ("[!] " if can_invert else "")
        raise PinError(
            f"Invalid pin description '{pin_desc}'{self._sections_using(pin_desc)}. "
            f"Format is: {prefix}[chip_name:] pin_name"
        )

    def _known_chips(self) -> str:
        return f" (known: {', '.join(sorted(self.chips))})" if self.chips else ""

    def _sections_using(self, pin_desc: str) -> str:
        """` (by [fan] pin, [heater_bed] heater_pin)` as far as the config says."""
        configfile = self._printer.lookup_object("configfile", None) if self._printer is not None else None
        if configfile is None:
            return ""
        users = configfile.users_of(pin_desc.strip().lstrip("^~!").replace(" ", ""))
        return f" (by {' and '.join(users)})" if users else ""


def get_printer_pins(printer: Any) -> PrinterPins:
    """The printer's pins."""
    pins: PrinterPins = printer.lookup_object("pins")
    return pins


def add_printer_objects(config: Any) -> None:
    """Make the object `pins`."""
    printer = config.get_printer()
    pins = PrinterPins(printer)
    printer.add_object("pins", pins)
    if config.has_section("duplicate_pin_override"):  # wherever it stands in the file
        for pin_desc in config.getsection("duplicate_pin_override").getlist("pins"):
            pins.allow_multi_use_pin(pin_desc)
