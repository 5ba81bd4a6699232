"""docs/reference/Simulation.md lists the parameters of the simulated nozzle as the C table has them."""

from __future__ import annotations

from pathlib import Path

from simulation import world as world_module
from simulation.world import parameter_tables

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "Simulation.md"


def table() -> str:
    """The page's table; `light` has `strong`'s values but for the mass, which the page says."""
    lines = [
        "| parameter | unit | `reference` | `strong` | `real` | range | |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in parameter_tables()["nozzle"].values():
        reference, strong, real = (f"{row.presets[name]:g}" for name in ("reference", "strong", "real"))
        shown = strong if strong != reference else ""
        added = real if real != reference else ""
        doc = row.doc.replace("|", "\\|")
        lines.append(
            f"| `{row.name}` | {row.unit} | {reference} | {shown} | {added} | {row.min:g} to {row.max:g} | {doc} |"
        )
    return "\n".join(lines) + "\n"


def test_page_has_every_parameter_with_its_unit_values_range_and_origin() -> None:
    world_module.build()
    assert table() in PAGE.read_text(encoding="utf-8"), f"the table should be:\n{table()}"


def test_light_is_strong_with_half_the_steel() -> None:
    world_module.build()
    rows = parameter_tables()["nozzle"]
    changed = {name for name, row in rows.items() if row.presets["light"] != row.presets["strong"]}
    assert changed == {"mass_g"}
    assert rows["mass_g"].presets["light"] == 0.46
