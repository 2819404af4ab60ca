"""From recordings to scenes of a map: one here, or many at once in worker processes."""
