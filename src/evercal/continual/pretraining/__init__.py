"""How the shipped encoder and descriptor are made: procedural images only."""
