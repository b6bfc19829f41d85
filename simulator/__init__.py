"""VTORCS: tracks, physics, traffic, sensors, camera and the Gymnasium environments."""
