"""Learning scenes one after another: what to keep, what to replay, how to distil."""
