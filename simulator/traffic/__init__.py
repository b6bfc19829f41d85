"""Traffic cars: intelligent driver model, lane changes, wrecks."""
