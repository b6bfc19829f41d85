"""Effects between scene and recorded picture: windscreen, bonnet, lens and sensor."""
