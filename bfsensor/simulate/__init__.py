"""The device simulator: mesh, electrostatics, pixel boundaries."""
