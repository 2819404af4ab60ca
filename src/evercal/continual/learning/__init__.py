"""Learning a scene with a network: stages, training rows, presets."""
