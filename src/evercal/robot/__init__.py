"""The arm: its URDF, forward kinematics and joint offsets; no images."""
