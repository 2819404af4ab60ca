"""The 3D view of a map in a browser (extra `view`): a page of viser."""
