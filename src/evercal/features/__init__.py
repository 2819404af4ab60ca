"""Dense features of an image: what the encoder sees of it, encoder, descriptor, their weights."""
