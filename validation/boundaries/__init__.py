"""Area changes of pixels do not depend on the mesh or on the simulated period."""
