"""Rendered rooms and robot cells with exact poses."""
