"""Hand-eye calibration from pairs of robot poses and camera poses."""
