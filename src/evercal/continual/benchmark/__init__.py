"""Methods compared over sequences of scenes: suites, runs, results on disk, tables."""
