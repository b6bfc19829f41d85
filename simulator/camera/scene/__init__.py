"""Builds and draws the scene: road, terrain, props, barriers, cars, sky and weather."""
