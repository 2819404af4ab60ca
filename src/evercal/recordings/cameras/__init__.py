"""Camera files: intrinsics and distortion, in the formats of other programs."""
