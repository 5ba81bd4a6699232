"""Templates that ask for too much end with an error, soon, and others run meanwhile."""

from __future__ import annotations

import gc
import time
import tracemalloc
from pathlib import Path

import pytest

from base_rig import Session
from reactor import SystemTime

WORDS = {
    "bits": "a number of more than 4096 bits",
    "text": "a text of more than 1000000 characters",
    "items": "a list of more than 100000 items",
    "width": "a width or a precision of more than 10000",
    "steps": "more than 200000 steps of loops and calls",
}


def config(template: str) -> str:
    lines = "\n".join(f"    {line}" for line in template.split("\n"))
    return f"[respond]\n[gcode_macro TRY]\ngcode:\n{lines}\n"


def doubled(start: str, step: str) -> str:
    """`s` grows by `step` in forty rounds."""
    return f"{{% set n = namespace(s={start}) %}}{{% for i in range(40) %}}{{% set n.s = {step} %}}{{% endfor %}}"


@pytest.mark.parametrize(
    ("template", "limit"),
    [
        ("{2**(2**30)}", "bits"),
        ("{10**10000}", "bits"),
        (doubled("3", "n.s * n.s"), "bits"),
        ("{'a' * 10**9}", "text"),
        ("{10**9 * 'a'}", "text"),
        (doubled("'ab'", "n.s + n.s"), "text"),
        (doubled("'ab'", "n.s ~ n.s"), "text"),
        (doubled("'ab'", "n.s.replace('a', n.s)"), "text"),
        (doubled("'ab'", "n.s|replace('a', n.s)"), "text"),
        ("{('a' * 100000).join(range(1000)|map('string')|list)}", "text"),
        ("{range(1000)|list|join('a' * 100000)}", "text"),
        ("{[0] * 10**9}", "items"),
        (doubled("[0, 1]", "n.s + n.s"), "items"),
        ("{% set s = [0, 1] %}{% for i in range(40) %}{% set x = s.extend(s) %}{% endfor %}", "items"),
        ("{'%1000000000d' % 1}", "width"),
        ("{'%*d' % (1000000000, 1)}", "width"),
        ("{'%1000000000d'|format(1)}", "width"),
        ("{'{:1000000000}'.format(1)}", "width"),
        ("{'{:{}}'.format(1, 1000000000)}", "width"),
        ("{'a'|center(1000000000)}", "width"),
        ("{'a'.rjust(1000000000)}", "width"),
        ("{1.5|round(1000000000, 'ceil')}", "width"),
        ("{['a']|map('center', 1000000000)|list}", "width"),
        ("{% for i in range(99999) %}{% for j in range(99999) %}{% endfor %}{% endfor %}", "steps"),
        ("{% macro f(n) %}{% if n %}{f(n - 1)}{f(n - 1)}{% endif %}{% endmacro %}{f(40)}", "steps"),
        ("{% set l = [0] %}{% for i in l %}{% set x = l.append(i) %}{% endfor %}", "steps"),
        ("{% for i in range(1000) %}{'a' * 1000000}{% endfor %}", "steps"),
    ],
)
def test_a_template_without_a_measure_is_an_error_soon(tmp_path: Path, template: str, limit: str) -> None:
    def body(s: Session) -> None:
        if limit != "steps":  # it makes them five times slower
            tracemalloc.start()
        begin_s = time.process_time()
        with pytest.raises(
            s.gcode.error, match=f"Error evaluating 'gcode_macro TRY:gcode': .*: {WORDS[limit]}"
        ):
            s.gcode.run_script("TRY")
        assert time.process_time() - begin_s < 3.0  # half a second for 200,000 steps
        assert tracemalloc.get_traced_memory()[1] < 30e6
        tracemalloc.stop()
        s.gcode.run_script("RESPOND MSG=on")
        assert s.lines[-1] == "echo: on"

    Session(tmp_path, config(template)).run(body)


def test_a_template_that_fails_leaves_nothing_for_the_search_for_cycles(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        gc.collect()
        for _ in range(20):
            with pytest.raises(s.gcode.error, match=WORDS["bits"]):
                s.gcode.run_script("TRY")
        assert gc.collect() < 20

    Session(tmp_path, config("{2**(2**30)}")).run(body)


@pytest.mark.parametrize(
    ("template", "text"),
    [
        ("{2**10} {2**-1} {(2.0**0.5)|round(2)}", "1024 0.5 1.41"),
        ("{'a' * 3 ~ 1 ~ none ~ missing}", "aaa1None"),
        ("{'%5.2f' % 1.234}{'%d%%' % 50}{'{:>4}'.format('x')}", " 1.2350%   x"),
        ("{% for i in range(150) %}{% if loop.last %}{loop.length} {loop.index}{% endif %}{% endfor %}", "150 150"),
        ("{% for k, v in {'a': 1}.items() %}{k}{v}{% else %}none{% endfor %}", "a1"),
        ("{% for i in [] %}x{% else %}none{% endfor %}", "none"),
        ("{% for i in [[1], []] recursive %}{% if i is iterable %}<{loop(i)}>{% endif %}{% endfor %}", "<><>"),
        ("{[3, 1]|sort|join(', ')}{'abc'|replace('b', 'x')}{'%s-%s'|format(1, 2)}", "1, 3axc1-2"),
        ("{100000|default(5)}{'a'|center(5)}{1.26|round(1)}", "100000  a  1.3"),
    ],
)  # fmt: skip
def test_what_macros_do_is_as_in_jinja(tmp_path: Path, template: str, text: str) -> None:
    def body(s: Session) -> None:
        macro = s.printer.lookup_object("gcode_macro TRY")
        assert macro.template.render() == text

    Session(tmp_path, config(template)).run(body)


def test_a_long_loop_lets_others_run(tmp_path: Path) -> None:
    longest_s, seen_s = 0.0, 0.0

    def look(eventtime: float) -> float:
        nonlocal longest_s, seen_s
        now_s = time.thread_time()
        longest_s, seen_s = max(longest_s, now_s - seen_s), now_s
        return eventtime + 0.001

    def body(s: Session) -> None:
        nonlocal longest_s

        s.reactor.register_timer(look, s.reactor.NOW)
        s.sleep(0.01)
        longest_s = 0.0
        with pytest.raises(s.gcode.error, match=WORDS["steps"]):
            s.gcode.run_script("TRY")
        s.sleep(0.01)

    loop = "{% for i in range(99999) %}{% set x = [i * 2, i ~ 'a']|join(',') %}{% endfor %}" * 3
    Session(tmp_path, config(loop), SystemTime()).run(body)
    assert longest_s < 0.050
