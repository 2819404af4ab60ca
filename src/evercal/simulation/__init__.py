"""Frames from a virtual cell instead of a disk."""
