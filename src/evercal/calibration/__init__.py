"""Hand-eye calibration: from images and robot poses to one transform that a robot can rely on."""
