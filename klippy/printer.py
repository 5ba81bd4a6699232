"""The printer: start-up, loading of modules, events, and the states startup, ready, error, shutdown."""

from __future__ import annotations

import collections
import importlib
import logging
import os
from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any

import chelper
import configfile
import extras
import gcode
import gcode_io
import msgproto
import pins
import serialhdl
import stepper
import webhooks
from link import serialport
from reactor import Reactor

MESSAGE_READY = "Printer is ready"
MESSAGE_STARTUP = (
    "Printer is not ready\nThe host is connecting to the printer's controllers. Please try again in a moment."
)
MESSAGE_RESTART = (
    'Once the underlying issue is corrected, use the "RESTART"\n'
    "command to reload the config and restart the host software.\nPrinter is halted"
)
_FIRMWARE_RESTART_ADVICE = (
    'Once the underlying issue is corrected, use the\n"FIRMWARE_RESTART" command to reset the firmware, '
    "reload the\nconfig, and restart the host software.\n"
)
MESSAGE_SHUTDOWN = _FIRMWARE_RESTART_ADVICE + "What to check: docs/guides/Trouble.md\nPrinter is shutdown"
MESSAGE_CONNECT = _FIRMWARE_RESTART_ADVICE + "Error configuring printer"
MESSAGE_INTERNAL = "This is an internal error of the host: the log has the details."

# Problems whose text is written for the user. All others are bugs, and logged with their traceback.
_CONFIG_PROBLEMS = (configfile.ConfigError, pins.PinError, gcode.CommandError)
_LINK_PROBLEMS = (msgproto.error, serialhdl.error, serialport.PortError, chelper.HelperError, stepper.error)

# A section that does not load makes others fail that refer to it: these texts only repeat the first problem.
_CONSEQUENCES = ("Unknown config object", "Unknown pin chip name")
_MISSING: Any = object()
PLUGINS = "plugins"
OWN_EXTRAS = os.path.join(os.path.dirname(os.path.abspath(__file__)), "extras")
EventHandler = Callable[..., Any]


class Printer:
    """Everything of one printer, by name. Lives from one restart to the next."""

    config_error = configfile.ConfigError
    command_error = gcode.CommandError
    CONFIG = configfile.PrinterConfig
    # Modules that make objects of their own, before and after the sections of the config are loaded
    CORE_FIRST: tuple[str, ...] = ("pins", "mcu")
    CORE_LAST: tuple[str, ...] = ("toolhead",)
    # Sections that exist whether or not they are written in the config
    ALWAYS: tuple[str, ...] = ("statistics", "idle_timeout", "tuning_tower", "manual_probe")

    def __init__(self, main_reactor: Reactor, start_args: dict[str, Any]) -> None:
        self.reactor = main_reactor
        self.start_args = start_args
        self.log_listener = start_args.get("log_listener")
        self.objects: collections.OrderedDict[str, Any] = collections.OrderedDict()
        self._events: dict[str, list[EventHandler]] = {}
        self._failed: dict[str, Exception] = {}  # sections that did not load, and why
        self._state = "startup"
        self._message = MESSAGE_STARTUP
        self._result: str | None = None
        self.in_shutdown_state = False
        dispatch = gcode.GCodeDispatch(self)
        self.add_object("gcode", dispatch)
        self.add_object("webhooks", webhooks.WebHooks(self))
        self.add_object("gcode_io", gcode_io.GCodeIO(self, dispatch))

    # --- state ---
    def get_reactor(self) -> Reactor:
        """The event loop."""
        return self.reactor

    def get_start_args(self) -> dict[str, Any]:
        """What the program was started with."""
        return self.start_args

    def get_state_message(self) -> tuple[str, str]:
        """Text for the user, and one of startup, ready, error, shutdown."""
        return self._message, self._state

    def is_shutdown(self) -> bool:
        """Whether the printer was stopped by an emergency or fault."""
        return self.in_shutdown_state

    def is_exiting(self) -> bool:
        """Whether this run is about to end."""
        return self._result is not None

    def set_rollover_info(self, name: str, info: str, log: bool = True) -> None:
        """Log text that is repeated in every new log file."""
        if log:
            logging.info(info)
        if self.log_listener is not None:
            self.log_listener.set_rollover_info(name, info)

    def _set_state(self, state: str, message: str) -> None:
        self._state, self._message = state, message

    # --- objects ---
    def add_object(self, name: str, obj: Any) -> None:
        """Make an object known by name."""
        if name in self.objects:
            raise self.config_error(f"Printer object '{name}' is already created")
        self.objects[name] = obj

    def lookup_object(self, name: str, default: Any = _MISSING) -> Any:
        """The object of that name."""
        found = self.objects.get(name, default)
        if found is _MISSING:
            raise self.config_error(f"Unknown config object '{name}'")
        return found

    def lookup_objects(self, module: str | None = None) -> list[tuple[str, Any]]:
        """All objects as (name, object), or those made by sections `[module ...]`."""
        if module is None:
            return list(self.objects.items())
        prefix = module + " "
        return [
            (name, obj) for name, obj in self.objects.items() if name == module or name.startswith(prefix)
        ]

    def load_object(self, config: Any, section: str, default: Any = _MISSING) -> Any:
        """The object of a config section, made by `extras/NAME.py` (or package, or plugin) on first use."""
        if section in self.objects:
            return self.objects[section]
        if section in self._failed:
            raise self._failed[section]
        words = section.split()
        module = self._import_extra(words[0]) if words else None
        loader = None
        if module is not None:
            loader = getattr(module, "load_config_prefix" if len(words) > 1 else "load_config", None)
        if loader is None:
            if default is not _MISSING:
                return default
            raise self.config_error(f"Unable to load module '{section}'")
        try:
            self.objects[section] = loader(config.getsection(section))
        except _CONFIG_PROBLEMS as e:
            self._failed[section] = e
            raise
        return self.objects[section]

    def _try(self, section: str, load: Callable[[], Any]) -> None:
        """Load a part of the printer; a problem of the config is kept, so that others are found, too."""
        try:
            load()
        except _CONFIG_PROBLEMS as e:
            self._failed[section] = e
        except Exception:
            if not self._failed:
                raise
            logging.exception("Section %s, after another did not load", section)

    def _import_extra(self, name: str) -> ModuleType | None:
        """Module `extras.NAME` if there is one. Raises config_error for a plugin that is broken."""
        path = _locate_extra(name)
        if path is None:
            return None
        try:
            return importlib.import_module(f"extras.{name}")
        except Exception as e:
            if path.startswith(OWN_EXTRAS + os.sep):
                raise
            logging.exception("Plugin %s", name)
            raise self.config_error(f"Plugin '{name}' ({path}) does not load: {e}") from None

    # --- events ---
    def register_event_handler(self, event: str, callback: EventHandler) -> None:
        """Call `callback(*params)` whenever `event` is sent."""
        self._events.setdefault(event, []).append(callback)

    def send_event(self, event: str, *params: Any) -> list[Any]:
        """Call all handlers of an event; returns what they returned."""
        return [handler(*params) for handler in self._events.get(event, ())]

    def _send_event_safely(self, event: str) -> None:
        """Every handler gets its turn, even if others fail."""
        for handler in self._events.get(event, ()):
            try:
                handler()
            except Exception:
                logging.exception("Error in a handler of %s", event)

    # --- start-up ---
    def _load_config(self) -> None:
        loader = self.CONFIG(self)
        self.add_object("configfile", loader)
        config = loader.read_main_config()
        if self.start_args.get("debuginput") is None or self.log_listener is not None:
            loader.log_config(config)
        del extras.__path__[1:]  # plugins of the run before a restart
        if config.has_section(PLUGINS):  # before anybody asks for a module of the user's
            self.load_object(config, PLUGINS)
        for name in self.CORE_FIRST:
            importlib.import_module(name).add_printer_objects(config)
        names = [section.get_name() for section in config.get_prefix_sections("")]
        for name in names:
            self._try(name, partial(self.load_object, config, name, None))
        for name in self.CORE_LAST:
            self._try(name, partial(importlib.import_module(name).add_printer_objects, config))
        for name in self.ALWAYS:
            self._try(name, partial(self.load_object, config, name))
        self._report_problems(loader.unused_options(set(self._failed)))
        loader.note_settings()

    def _report_problems(self, unused: list[str]) -> None:
        """Raise config_error with all problems of the config, if there are any."""
        failures = list(dict.fromkeys(str(e) for e in self._failed.values()))
        own = [text for text in failures if not text.startswith(_CONSEQUENCES)]
        problems = [*(own or failures), *unused]
        if problems:
            raise self.config_error("\n".join(problems))

    def _connect(self, eventtime: float) -> None:
        try:
            self._load_config()
            for event in ("klippy:mcu_identify", "klippy:connect"):
                for handler in self._events.get(event, ()):
                    if self._state != "startup":
                        return
                    handler()
        except _CONFIG_PROBLEMS as e:
            self._fail(str(e), MESSAGE_RESTART)
            return
        except _LINK_PROBLEMS as e:
            self._fail(str(e), MESSAGE_CONNECT)
            return
        except Exception as e:
            logging.exception("Unhandled exception during connect")
            self._fail(f"Internal error during connect: {e}", f"{MESSAGE_INTERNAL}\n{MESSAGE_RESTART}")
            return
        self._become_ready()

    def _become_ready(self) -> None:
        try:
            self._set_state("ready", MESSAGE_READY)
            for handler in self._events.get("klippy:ready", ()):
                if self._state != "ready":
                    return
                handler()
        except Exception as e:
            known = isinstance(e, _CONFIG_PROBLEMS + _LINK_PROBLEMS)
            if not known:
                logging.exception("Unhandled exception during ready")
            self.invoke_shutdown(str(e) if known else f"Internal error during ready: {e}")

    def _fail(self, reason: str, advice: str) -> None:
        """Start-up did not succeed: report why, and wait for a RESTART (batch mode: end)."""
        logging.error(reason)
        self._set_state("error", f"{reason}\n{advice}")
        self._send_event_safely("klippy:notify_mcu_error")
        if self.start_args.get("debuginput") is not None:
            self.request_exit("error_exit")

    # --- shutdown and exit ---
    def invoke_shutdown(self, msg: str, details: dict[str, Any] | None = None) -> None:
        """Stop the printer now; only the first reason is kept."""
        if self.in_shutdown_state:
            return
        logging.error("Transition to shutdown state: %s", msg)
        self.in_shutdown_state = True
        self._set_state("shutdown", f"{msg}\n{MESSAGE_SHUTDOWN}")
        self._send_event_safely("klippy:shutdown")
        logging.info("Reactor time at shutdown: %.6f", self.reactor.monotonic())
        for handler in self._events.get("klippy:notify_mcu_shutdown", ()):
            handler(msg, details or {})
        if self.start_args.get("debuginput") is not None:
            self.request_exit("error_exit")

    def invoke_async_shutdown(self, msg: str, details: dict[str, Any] | None = None) -> None:
        """As `invoke_shutdown`, from any thread."""
        self.reactor.register_async_callback(lambda eventtime: self.invoke_shutdown(msg, details))

    def request_exit(self, result: str) -> None:
        """End this run: `exit error_exit restart firmware_restart`."""
        if self._result is None or result == "error_exit":
            self._result = result
        self.reactor.end()

    def run(self) -> str:
        """Start the printer and serve it until its end is requested; returns why it ended."""
        self.reactor.register_callback(self._connect)
        try:
            self.reactor.run()
        except Exception:
            logging.exception("Unhandled exception during run")
            self._result = "error_exit"
        result = self._result or "exit"
        self.reactor.register_callback(lambda eventtime: self._disconnect(result))
        try:
            self.reactor.run()
        except Exception:
            logging.exception("Unhandled exception at the end")
            result = "error_exit"
        return result

    def _disconnect(self, result: str) -> None:
        """Last words to everybody, with the loop still running so that they may wait for answers."""
        try:
            if result == "firmware_restart":
                self._send_event_safely("klippy:firmware_restart")
            self._send_event_safely("klippy:disconnect")
        finally:
            self.reactor.end()


def _locate_extra(name: str) -> str | None:
    """File of the module `extras.NAME`, ours or a plugin of the user's; None if there is none."""
    if not name.isidentifier():
        return None
    for folder in extras.__path__:
        for path in (os.path.join(folder, f"{name}.py"), os.path.join(folder, name, "__init__.py")):
            if os.path.exists(path):
                return path
    return None
