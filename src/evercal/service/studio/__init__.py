"""The studio: from a camera and an arm to exported calibrations in the browser (extra `view`)."""
