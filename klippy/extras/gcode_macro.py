"""[gcode_macro NAME]: commands made of G-code templates (Jinja2), and templates for other modules.

Templates are rendered completely before their first line runs. They run in Jinja's sandbox: they read printer status
and compute, nothing else, within the limits of macros/limits.py. They may change their own dicts and lists, also by
`d.__setitem__(key, value)`: Jinja has no statement for that.
"""

from __future__ import annotations

import ast
import json
import logging
from collections.abc import Iterator
from typing import Any

import jinja2

from configfile import ConfigWrapper
from gcode import GCodeCommand
from gcode_command import is_traditional
from roles import Printer

from .macros.limits import BUDGET, Budget, LimitedSandbox

CONTAINER_METHODS = frozenset({"__contains__", "__delitem__", "__getitem__", "__len__", "__setitem__"})


class MacroSandbox(LimitedSandbox):
    """Jinja's sandbox forbids names that begin with two underscores. Here a container's items are an exception."""

    def is_safe_attribute(self, obj: Any, attr: str, value: Any) -> bool:
        """Whether a template may use this attribute."""
        if attr in CONTAINER_METHODS and isinstance(obj, dict | list):
            return True
        return super().is_safe_attribute(obj, attr, value)


class StatusView:
    """`printer` inside a template: status of any object, read once per rendering."""

    def __init__(self, printer: Printer, eventtime: float | None = None) -> None:
        self._printer = printer
        self._eventtime = eventtime
        self._seen: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        key = str(name).strip()
        if key not in self._seen:
            found = self._printer.lookup_object(key, None)
            report = getattr(found, "get_status", None)
            if report is None:
                raise KeyError(name)
            if self._eventtime is None:
                self._eventtime = self._printer.get_reactor().monotonic()
            # a macro may change what its dicts and lists hold, also one macro those of another
            is_macro = isinstance(found, GCodeMacro)
            self._seen[key] = dict(found.variables if is_macro else report(self._eventtime))
        return self._seen[key]

    def __contains__(self, name: object) -> bool:
        return hasattr(self._printer.lookup_object(str(name).strip(), None), "get_status")

    def __iter__(self) -> Iterator[str]:
        return (name for name, obj in self._printer.lookup_objects() if hasattr(obj, "get_status"))


class TemplateWrapper:
    """One compiled template."""

    def __init__(
        self, printer: Printer, environment: jinja2.Environment, name: str, script: str, where: str = ""
    ) -> None:
        self.printer = printer
        self.name = name
        self._gcode = printer.lookup_object("gcode")
        self._macros = printer.lookup_object("gcode_macro")
        try:
            self._template = environment.from_string(script)
        except jinja2.TemplateError as e:
            line = f" line {e.lineno}" if isinstance(e, jinja2.TemplateSyntaxError) else ""
            raise printer.config_error(f"Error loading template '{name}'{where}:{line} {e}") from None

    def create_template_context(self, eventtime: float | None = None) -> dict[str, Any]:
        """Names a template may use."""
        return self._macros.create_template_context(eventtime)

    def render(self, context: dict[str, Any] | None = None) -> str:
        """The text; problems of the template come out as command errors."""
        try:
            values = self.create_template_context() if context is None else context
            return self._template.render({**values, BUDGET: Budget(self.printer.get_reactor())})
        except self._gcode.error:
            raise
        except Exception as e:
            reason = str(e).replace(f"'{StatusView.__module__}.{StatusView.__name__} object'", "'printer'")
            message = f"Error evaluating '{self.name}': {type(e).__name__}: {reason}"
        logging.info(message)
        raise self._gcode.error(message)

    def run_gcode_from_command(self, context: dict[str, Any] | None = None) -> None:
        """Render and run, inside a command."""
        self._gcode.run_script_from_command(self.render(context))


class PrinterGCodeMacro:
    """The object `gcode_macro`: makes templates."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self._environment = MacroSandbox(
            block_start_string="{%",
            block_end_string="%}",
            variable_start_string="{",
            variable_end_string="}",
            extensions=["jinja2.ext.do", "jinja2.ext.loopcontrols"],
        )

    def load_template(
        self, config: ConfigWrapper, option: str, default: str | None = None
    ) -> TemplateWrapper:
        """The template written in an option."""
        script = config.get(option) if default is None else config.get(option, default)
        return TemplateWrapper(
            self.printer,
            self._environment,
            f"{config.get_name()}:{option}",
            script,
            f" ({config.where(option)})",
        )

    def create_template_context(self, eventtime: float | None = None) -> dict[str, Any]:
        """Names every template may use."""
        return {
            "printer": StatusView(self.printer, eventtime),
            "action_emergency_stop": self._action_emergency_stop,
            "action_respond_info": self._action_respond_info,
            "action_log": self._action_log,
            "action_raise_error": self._action_raise_error,
            "action_call_remote_method": self._action_call_remote_method,
        }

    def _action_emergency_stop(self, msg: str = "action_emergency_stop") -> str:
        self.printer.invoke_shutdown(f"Shutdown due to {msg}")
        return ""

    def _action_respond_info(self, msg: str) -> str:
        self.printer.lookup_object("gcode").respond_info(str(msg))
        return ""

    def _action_log(self, msg: str) -> str:
        logging.info(msg)
        return ""

    def _action_raise_error(self, msg: str) -> str:
        raise self.printer.command_error(str(msg))

    def _action_call_remote_method(self, method: str, **kwargs: Any) -> str:
        self.printer.lookup_object("webhooks").call_remote_method(method, **kwargs)
        return ""


def parse_literal(text: str) -> Any:
    """A Python literal that JSON can express, of finite numbers; ValueError otherwise."""
    try:
        value = ast.literal_eval(text)
        json.dumps(value, allow_nan=False)
    except (SyntaxError, TypeError, ValueError, RecursionError, MemoryError) as e:
        raise ValueError(str(e)) from None
    return value


def _frozen(value: Any) -> Any:
    """A copy that does not change with the dicts and lists of the original."""
    if isinstance(value, dict):
        return {key: _frozen(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)([_frozen(item) for item in value])
    return value


class GCodeMacro:
    """One macro; its status is its variables."""

    def __init__(
        self, printer: Printer, name: str, template: TemplateWrapper, variables: dict[str, Any]
    ) -> None:
        self.printer = printer
        self.name = name
        self.alias = name.upper()
        self.gcode = printer.lookup_object("gcode")
        self.template = template
        self.variables = variables
        self._running = False

    def register(self, description: str, rename_existing: str | None) -> None:
        """Become a command, now, or instead of an existing one once all of those are known."""
        self.gcode.register_mux_command(
            "SET_GCODE_VARIABLE",
            "MACRO",
            self.name,
            self.cmd_SET_GCODE_VARIABLE,
            desc="Set the value of a G-Code macro variable",
        )
        if rename_existing is None:
            self.gcode.register_macro(self.alias, self.cmd, description)
            return
        new_name = rename_existing.upper()
        if is_traditional(self.alias) != is_traditional(new_name):
            raise self.printer.config_error(
                f"G-code macro rename of different types ('{self.alias}' vs '{rename_existing}'): "
                "either both are a letter and a number, or none"
            )
        self.printer.register_event_handler("klippy:connect", lambda: self._take_over(new_name, description))

    def _take_over(self, new_name: str, description: str) -> None:
        previous = self.gcode.register_command(self.alias, None)
        if previous is not None:
            self.gcode.register_command(new_name, previous, desc=f"Renamed builtin of '{self.alias}'")
        else:
            raise self.printer.config_error(
                f"Existing command '{self.alias}' not found in gcode_macro rename"
            )
        self.gcode.register_command(self.alias, self.cmd, desc=description)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """The variables, as they are now: the macro may change what its dicts and lists hold later."""
        return {name: _frozen(value) for name, value in self.variables.items()}

    def cmd_SET_GCODE_VARIABLE(self, gcmd: GCodeCommand) -> None:
        """Give a variable a new value."""
        variable, text = gcmd.get("VARIABLE"), gcmd.get("VALUE")
        if variable not in self.variables:
            raise gcmd.error(f"Unknown gcode_macro variable '{variable}'")
        try:
            value = parse_literal(text)
        except ValueError as e:
            raise gcmd.error(f"Unable to parse '{text}' as a literal: {e}") from None
        self.variables = {**self.variables, variable: value}

    def cmd(self, gcmd: GCodeCommand) -> None:
        """Run the macro."""
        if self._running:
            raise gcmd.error(f"Macro {self.alias} called recursively")
        context = {
            **self.variables,
            **self.template.create_template_context(),
            "params": dict(gcmd.get_command_parameters()),
            "rawparams": gcmd.get_raw_command_parameters(),
        }
        self._running = True
        try:
            self.template.run_gcode_from_command(context)
        finally:
            self._running = False


def load_config(config: ConfigWrapper) -> PrinterGCodeMacro:
    """Loaded by sections that have templates."""
    return PrinterGCodeMacro(config.get_printer())


def _read_variables(config: ConfigWrapper) -> dict[str, Any]:
    prefix = "variable_"
    variables: dict[str, Any] = {}
    for option in config.get_prefix_options(prefix):
        text = config.get(option)
        try:
            variables[option[len(prefix) :]] = parse_literal(text)
        except ValueError as e:
            raise config.error(
                f"Option '{option}' in section '{config.get_name()}' is not a valid literal: {e} "
                f"({config.where(option)})"
            ) from None
    return variables


def load_config_prefix(config: ConfigWrapper) -> GCodeMacro:
    """Section [gcode_macro NAME]."""
    words = config.get_name().split()
    if len(words) != 2:
        raise config.error(
            f"Name of section '{config.get_name()}' contains illegal whitespace ({config.where()})"
        )
    printer = config.get_printer()
    template = printer.load_object(config, "gcode_macro").load_template(config, "gcode")
    macro = GCodeMacro(printer, words[1], template, _read_variables(config))
    macro.register(config.get("description", "G-Code macro"), config.get("rename_existing", None))
    return macro
