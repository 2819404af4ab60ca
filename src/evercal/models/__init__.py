"""Networks: local encoder, global descriptor and scene-coordinate head, and the shipped weights."""
