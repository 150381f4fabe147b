"""Sensors for GalSim: distortion tables applied in photon shooting."""

from bfsensor.sensor.brighter_fatter import BrighterFatterSensor
from bfsensor.sensor.shift_maps import ShiftMap
from bfsensor.sensor.silicon_sensor import SiliconSensor

__all__ = ["BrighterFatterSensor", "ShiftMap", "SiliconSensor"]
