"""The studio: from a camera and an arm to exported calibrations in the browser (extra `view`).

`studio` and the files that it imports decide what can be done and do it, without viser. `page`,
`panels`, `calibrate_panels` and `drawing` show it.
"""
