"""The printer's figures for Prometheus ([metrics]) and the nozzle's own as sensors, on the simulated printer."""

from __future__ import annotations

import re
import socket
import threading
import time
import urllib.request
from pathlib import Path

from prometheus_client.openmetrics.parser import text_string_to_metric_families

from system.conftest import ROOT, Simulate, machine

SECTIONS = """
[metrics]
port: {port}
[temperature_sensor melt]
sensor_type: induction_melt
[temperature_sensor watts]
sensor_type: induction_power
[temperature_sensor sigma]
sensor_type: induction_sigma
heater: nozzle
[temperature_sensor plan]
sensor_type: induction_plan
[temperature_sensor drift]
sensor_type: induction_drift
"""
SHOW = """
[gcode_macro SHOW]
gcode:
    {% for name in ("melt", "watts", "sigma", "plan", "drift") %}
    { action_respond_info("FIGURE %s=%s" % (name, printer["temperature_sensor " + name].temperature)) }
    {% endfor %}
"""
HOLD = "G28\nM104 S220\nM109 S220\nG4 P4000\nSHOW\nG4 P60000\nM104 S0\n"
NOT_KNOWN_YET = {"ferrite_nozzle_drift_celsius"}  # one minute of holding says nothing about it
OPENMETRICS = "application/openmetrics-text; version=1.0.0"


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def poll(port: int, texts: list[str], over: threading.Event) -> None:
    request = urllib.request.Request(f"http://127.0.0.1:{port}/metrics", headers={"Accept": OPENMETRICS})
    while not over.is_set():
        try:
            with urllib.request.urlopen(request, timeout=5.0) as answer:
                texts.append(answer.read().decode())
        except OSError:
            pass
        time.sleep(0.02)


def test_metrics_are_open_metrics_text_and_the_nozzle_s_figures_are_sensors(
    simulate: Simulate, tmp_path: Path
) -> None:
    port = free_port()
    texts: list[str] = []
    over = threading.Event()
    reader = threading.Thread(target=poll, args=(port, texts, over))
    reader.start()
    run = simulate(HOLD, machine(tmp_path, SECTIONS.format(port=port) + SHOW))
    over.set()
    reader.join()
    assert run.status == 0, run.stderr
    shown = dict(re.findall(r"FIGURE (\w+)=([-.\d]+)", run.log.read_text()))
    assert float(shown["plan"]) == 220.0
    assert abs(float(shown["melt"]) - 220.0) < 3.0  # nothing flows: the melt is as warm as the wall
    assert 2.0 < float(shown["watts"]) < 12.0  # 4 W hold 220 degC, the holder takes the rest while it warms
    assert 0.0 < float(shown["sigma"]) < 3.0
    whole = [text for text in texts if text.endswith("# EOF\n") and "ferrite_nozzle_power_watts{" in text]
    assert whole, "nothing was served while the print ran"
    families = {f.name: f.samples for f in text_string_to_metric_families(whole[-1])}
    heat = {s.labels["heater"]: s.value for s in families["ferrite_heater_temperature_celsius"]}
    assert set(heat) >= {"extruder", "heater_bed"}
    assert (
        max(
            s.value
            for text in whole
            for f in text_string_to_metric_families(text)
            if f.name == "ferrite_heater_target_celsius"
            for s in f.samples
        )
        == 220.0
    )
    for name in ("mcu_retransmitted_bytes", "lookahead_seconds", "motion_stalls", "fan_speed_ratio"):
        assert families[f"ferrite_{name}"], name
    states = [s for s in families["ferrite_nozzle_fault"] if s.labels["nozzle"] == "nozzle"]
    assert [s.value for s in states] == [0.0]

    served = {s.name for f in text_string_to_metric_families(whole[-1]) for s in f.samples}
    for page in ("docs/guides/grafana-dashboard.json", "docs/guides/Monitoring.md"):
        named = set(re.findall(r"ferrite_\w+", (ROOT / page).read_text()))
        assert named <= served | NOT_KNOWN_YET, page
    in_guide = set(re.findall(r"ferrite_\w+", (ROOT / "docs/guides/Monitoring.md").read_text()))
    assert served <= in_guide


def test_a_port_in_use_and_an_unknown_nozzle_are_named(simulate: Simulate, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        run = simulate("G28\n", machine(tmp_path, f"[metrics]\nport: {port}\n"))
    assert run.status != 0
    assert f"port {port}" in run.stderr and "[metrics]" in run.stderr and "printer.cfg" in run.stderr
    run = simulate(
        "G28\n",
        machine(tmp_path, "[temperature_sensor melt]\nsensor_type: induction_melt\nheater: tip\n"),
    )
    assert run.status != 0
    assert "induction_heater tip" in run.stderr and "known: nozzle" in run.stderr
