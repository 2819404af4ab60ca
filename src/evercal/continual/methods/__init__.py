"""Continual-learning methods, one file per family."""
