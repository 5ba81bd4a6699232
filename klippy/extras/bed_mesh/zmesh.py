"""A mesh as plugins make it: `ZMesh(params, name)`, `build_mesh(rows)`, then `bed_mesh.set_mesh(mesh)`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ..probing import surface_fit
from .config import Profile
from .points import MeshError, MeshShape


class ZMesh:
    """Parameters are those of a saved profile. Raises MeshError."""

    def __init__(self, params: Mapping[str, Any], name: str | None) -> None:
        self.name = name or "adaptive"
        algorithm = params.get("algo", "lagrange")
        self._shape = MeshShape(
            (params["min_x"], params["min_y"]),
            (params["max_x"], params["max_y"]),
            (params["x_count"], params["y_count"]),
            (params["mesh_x_pps"], params["mesh_y_pps"]) if algorithm != "direct" else (0, 0),
            "lagrange" if algorithm == "direct" else algorithm,
            params.get("tension", 0.2),
        ).checked()
        self.profile: Profile | None = None
        self._surface: surface_fit.Surface | None = None

    def build_mesh(self, z_matrix: Sequence[Sequence[float]]) -> None:
        """Rows of heights, the front one first."""
        columns, count = self._shape.counts
        if len(z_matrix) != count or any(len(row) != columns for row in z_matrix):
            raise MeshError(f"the mesh is not {count} rows of {columns} heights")
        rows = tuple(tuple(float(z) for z in row) for row in z_matrix)
        self.profile = Profile(self._shape, rows)
        self._surface = self._shape.surface(rows)

    def _built(self) -> surface_fit.Surface:
        if self._surface is None:
            raise MeshError("the mesh has no heights yet: build_mesh() comes first")
        return self._surface

    def get_profile_name(self) -> str:
        return self.name

    def get_mesh_params(self) -> dict[str, Any]:
        return Profile(self._shape, ()).mesh_params()

    def get_probed_matrix(self) -> list[list[float]]:
        return [list(row) for row in self.profile.rows] if self.profile is not None else [[]]

    def get_mesh_matrix(self) -> list[list[float]]:
        return self._built().heights

    def get_z_range(self) -> tuple[float, float]:
        """Lowest and highest."""
        return self._built().range()

    def get_z_average(self) -> float:
        return self._built().mean()

    def calc_z(self, x: float, y: float) -> float:
        """mm."""
        return self._built().z(x, y)
