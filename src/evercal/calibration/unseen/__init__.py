"""Data that a calibration has not seen, for `verify`."""
