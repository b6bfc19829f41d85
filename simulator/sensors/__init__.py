"""The sensors of the table of sensors in the paper (Li et al.), and a class to declare additional
sensors."""

from simulator.sensors.sensor import Reading, Sensor, SensorSuite
from simulator.sensors.standard import STANDARD, camera_sensor, sensors_of

__all__ = ["STANDARD", "Reading", "Sensor", "SensorSuite", "camera_sensor", "sensors_of"]
