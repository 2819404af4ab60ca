"""The scene-coordinate network and its training, independent of any continual-learning method."""
