"""Furnished rooms with a robot arm, path-traced: furniture, materials, renderer."""
