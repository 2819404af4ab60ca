"""Comparison of strategies over sequences of scenes: suites, runs, results on disk, tables."""
