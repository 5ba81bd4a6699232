"""What probes, bed meshes and levelling share: points, the switch of a probe, surfaces through heights."""
