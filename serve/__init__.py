"""The perception service: clients send a driver-view image and receive its track features."""
