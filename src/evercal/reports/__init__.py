"""HTML reports, charts and image overlays."""
