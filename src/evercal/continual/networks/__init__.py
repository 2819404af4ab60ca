"""Fitting a scene-coordinate head to rows of features; knows no method."""
