"""Writes a calibration in the formats of other programs; one family of formats, one file.

`formats.FORMATS` lists them all. A new one is a function that takes an `Export` and returns text,
bytes or a folder of texts, and one line there. Every format is read back in the tests by a reader
that is not ours where there is one.
"""
