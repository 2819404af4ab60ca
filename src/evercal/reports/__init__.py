"""HTML pages and pictures of what the other folders found out."""
