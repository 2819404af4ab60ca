"""A scene in space: what is drawn of its map, cameras and their uncertainty."""
