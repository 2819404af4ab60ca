"""Fixed cameras without motions of a robot: by a known place, by points, or beside each other."""
