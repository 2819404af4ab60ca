"""Furnished rooms with an arm, path traced: the simulator beside the package."""
