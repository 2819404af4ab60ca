"""Calibration boards: corners, poses and intrinsics."""
