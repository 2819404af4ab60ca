"""Measurements of evercal that the docs report."""
