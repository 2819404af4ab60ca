"""Calibration boards: corner detection, board poses and intrinsics."""
