"""Features of an image: views, encoder, image descriptor and their weights."""
