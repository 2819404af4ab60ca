"""Selection of the frames that a method remembers."""
