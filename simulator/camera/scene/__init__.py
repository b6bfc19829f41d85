"""Geometry and drawing of the scene: road, terrain, props, barriers, cars, sky, weather."""
