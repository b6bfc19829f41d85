"""What lies between the scene and the recorded picture: windscreen, bonnet, lens and sensor."""
