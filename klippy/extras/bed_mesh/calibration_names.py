"""`bed_mesh.bmc`: the options of [bed_mesh] by the names that plugins read and set."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

from .config import MeshOptions, Profile
from .points import Layout, MeshShape


class Mesh(Protocol):
    """[bed_mesh] itself."""

    shape: MeshShape
    options: MeshOptions

    def plan(self, shape: MeshShape) -> Layout: ...


class CalibrationNames:
    """`bmc` and its `probe_mgr` in one."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self.mesh_config = Profile(mesh.shape, ()).mesh_params()  # a plugin's own mesh starts from this
        self.probe_mgr = self

    @property
    def zero_ref_pos(self) -> tuple[float, float] | None:
        """mm; where the mesh is 0."""
        return self._mesh.options.zero_reference

    @zero_ref_pos.setter
    def zero_ref_pos(self, place: Any) -> None:
        place = None if place is None else (float(place[0]), float(place[1]))
        self._mesh.options = replace(self._mesh.options, zero_reference=place)

    def get_base_points(self) -> list[tuple[float, float]]:
        """The places of the next mesh, mm."""
        return self._mesh.plan(self._mesh.shape).places()
