"""The simulated world: ego car, walls, traffic and contact physics."""
