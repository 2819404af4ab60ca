"""The 3D view of a map in a browser: what is shown (no viser), and the page (extra `view`).

`map_parts`, `frusta`, `answers` and `calibrations` compute points, colours, frusta, ellipsoids and
pictures. `stage` puts them into the scene of the page, and `panel`, `playback` and `live` into the
controls beside it.
"""
