"""From a recording to the map of its scene, and to the store of maps on disk."""
