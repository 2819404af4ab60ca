"""Training of the shipped encoder and descriptor on procedural images."""
