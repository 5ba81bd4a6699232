"""[menu]: elements, keys and templates, on a character display."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from bus_rig import BusSession, run, start_error

PINS = "".join(f"{name}_pin: PA{i}\n" for i, name in enumerate(("rs", "e", "d4", "d5", "d6", "d7")))
DISPLAY = f"[display]\nlcd_type: hd44780\n{PINS}"
BUTTONS = "encoder_pins: ^PB1, ^PB2\nclick_pin: ^!PB3\nkill_pin: ^!PB4\n"
LIST = """menu_root: mine
[respond]
[menu mine]
type: list
name: Mine
[menu mine first]
type: command
name: First
gcode: M118 {menu.event} {menu.ns} {menu.width}
[menu mine value]
type: input
name: V {"%.1f" % menu.input}
input: 0.3
input_min: 0
input_max: 100
input_step: 0.1
gcode: M118 value {menu.input}
[menu mine live]
type: input
name: L {menu.input}
input: 5
input_max: 6
input_step: 1
realtime: True
gcode: M118 live {menu.event} {menu.input}
[menu mine hidden]
type: command
name: Hidden
enable: {False}
[menu mine gone]
type: disabled
gcode: whatever
[menu mine top]
type: command
name: Top
index: 0
gcode: {menu.exit()}
"""


class Hand:
    """Keys pressed one after another, and what is to be seen after them."""

    def __init__(self, session: BusSession) -> None:
        self.session = session
        self.menu = session.printer.lookup_object("menu")
        self.screen = session.printer.lookup_object("display")
        session.sleep(1.0)

    def __call__(self, *keys: str) -> list[str]:
        for key in keys:
            self.menu.on_key(key, self.session.reactor.monotonic())
            self.screen.redraw_soon()
            self.session.sleep(0.2)
        letters, columns = self.screen.panel.letters, self.screen.panel.columns
        return [letters[i : i + columns].decode().rstrip() for i in range(0, len(letters), columns)]

    def status(self) -> dict[str, Any]:
        return dict(self.menu.get_status(0.0))


def said(session: BusSession) -> list[str]:
    return [line.removeprefix("echo: ") for line in session.lines if line.startswith("echo: ")]


def test_a_list_has_its_elements_in_order_without_those_taken_away(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        hand = Hand(s)
        assert hand("click") == [" ..", ">Top", " First", " V 0.3"]
        assert hand("next", "next", "next", "next", "next") == [" Top", " First", " V 0.3", ">L 5.0"]
        assert hand(*["previous"] * 9) == [">..", " Top", " First", " V 0.3"]

    run(tmp_path, DISPLAY + LIST, body)


def test_a_command_runs_at_a_click_and_knows_its_event(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        hand = Hand(s)
        hand("click", "next", "click", "long_click")
        assert said(s) == ["click mine first 20", "long_click mine first 20"]
        assert hand.status()["running"]

    run(tmp_path, DISPLAY + LIST, body)


def test_a_value_is_set_when_editing_ends_and_given_up_by_back(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        hand = Hand(s)
        assert hand("click", "next", "next", "click")[3] == "*V 0.3"
        assert hand("next", "next", "previous", "fast_next")[3] == "*V 1.4", "fast: ten steps at once"
        assert hand(*["fast_previous"] * 3)[3] == "*V 0.0"
        assert said(s) == []
        assert hand("next", "click")[3] == ">V 0.3", "the configured value is shown again"
        assert said(s) == ["value 0.1"]
        hand("click", "next", "back")
        assert said(s) == ["value 0.1"]
        assert hand.status() == {"running": True, "list": "mine", "selected": "mine value", "editing": False}

    run(tmp_path, DISPLAY + LIST, body)


def test_a_realtime_value_is_set_at_each_change_within_its_limits(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        Hand(s)("click", "next", "next", "next", "click", "next", "next", "previous", "click")
        assert said(s) == ["live change 6.0", "live change 5.0"]

    run(tmp_path, DISPLAY + LIST, body)


def test_back_and_the_first_entry_lead_out_and_a_template_may_leave(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        hand = Hand(s)
        for keys in (["click", "back"], ["click", "previous", "click"], ["click", "click"]):
            hand(*keys)
            assert not hand.status()["running"], keys

    run(tmp_path, DISPLAY + LIST, body)


@pytest.mark.parametrize(
    ("option", "keys", "selected"),
    [
        ("", ("down", "down", "up"), "mine first"),
        ("menu_reverse_navigation: True\n", ("up", "up", "down"), "mine first"),
    ],
)
def test_up_and_down_move_as_they_say_or_reversed(
    tmp_path: Path, option: str, keys: tuple[str, ...], selected: str
) -> None:
    def body(s: BusSession) -> None:
        hand = Hand(s)
        hand("click", *keys)
        assert hand.status()["selected"] == selected

    run(tmp_path, DISPLAY + option + LIST, body)


def test_a_menu_that_nobody_uses_is_left(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        hand = Hand(s)
        hand("click")
        s.sleep(4.0)
        assert hand.status()["running"]
        s.sleep(2.0)
        assert not hand.status()["running"]

    run(tmp_path, DISPLAY + "menu_timeout: 5\n" + LIST, body)


def test_the_default_menu_can_be_changed_element_by_element(tmp_path: Path) -> None:
    more = "[menu __main __setup]\ntype: disabled\n[menu __main __hello]\ntype: command\nname: Hello\ngcode: M117 x\n"

    def body(s: BusSession) -> None:
        hand = Hand(s)
        hand("click")
        names = [
            element.ns for element in hand.menu._levels[0].element.children if element.kind != "disabled"
        ]
        assert "__main __hello" in names and "__main __control" in names
        assert "__main __setup" not in names

    run(tmp_path, DISPLAY + more, body)


def test_the_kill_button_stops_the_printer_and_a_held_click_is_a_long_one(tmp_path: Path) -> None:
    def body(s: BusSession) -> None:
        hand = Hand(s)
        oid = next(oid for name, oid in s.chip.handlers if name == "buttons_state")
        hand("click", "next")
        click, idle = 0b0100, 0b0000
        s.chip.report("buttons_state", oid, ack_count=0, state=bytes([click]))
        s.sleep(1.0)
        s.chip.report("buttons_state", oid, ack_count=1, state=bytes([idle]))
        s.sleep(0.1)
        assert said(s) == ["long_click mine first 20"]
        s.chip.report("buttons_state", oid, ack_count=2, state=bytes([0b1000]))
        assert s.state[1] == "shutdown"
        assert "Shutdown due to kill button!" in s.state[0]

    run(tmp_path, DISPLAY + BUTTONS + LIST, body)


WRONG = {
    "menu_root: nowhere\n": "Option 'menu_root' in section 'display': there is no list [menu nowhere]",
    "click_pin: ^PB1\nencoder_pins: ^PB2\n": "Option 'encoder_pins' in section 'display': must have 2 elements",
    "encoder_steps_per_detent: 3\n": "Option 'encoder_steps_per_detent' in section 'display': '3' is not one of",
    "analog_range_click_pin: 1, 2\n": "Option 'click_pin' in section 'display' must be specified",
    "[menu a]\nname: x\n": "Option 'type' in section 'menu a' must be specified",
    "[menu a]\ntype: lst\nname: x\n": "Option 'type' in section 'menu a': 'lst' is not one of the choices",
    "[menu a b]\ntype: command\nname: x\n": "Section 'menu a b' belongs to a list 'menu a', which is not there",
    "[menu a]\ntype: input\nname: x\ninput: 1\ninput_step: 0\n": "Option 'input_step' in section 'menu a': must be",
    "[menu a]\ntype: list\nname: {% x %}\n": "Error loading template 'menu a:name'",
    "[menu a]\ntype: list\nname: x\nnmae: y\n": "Option 'nmae' is not valid in section 'menu a'",
}


@pytest.mark.parametrize("text", WRONG)
def test_wrong_options_are_named_with_their_place(tmp_path: Path, text: str) -> None:
    reason = start_error(tmp_path, DISPLAY + text)
    (line,) = [line for line in reason.splitlines() if line.startswith(WRONG[text])]
    assert "(printer.cfg, line " in line
