"""The ego car: parameters, tyre and wheel forces, powertrain, rigid-body motion, state."""
