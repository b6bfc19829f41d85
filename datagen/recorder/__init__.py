"""Recording one round: simulation, camera, writing, and replaying it."""
