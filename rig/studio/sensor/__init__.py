"""What a camera makes of the scene: lens and sensor noise, planted faults, presets."""
