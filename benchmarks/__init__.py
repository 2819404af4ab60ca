"""Long measurements, apart from the test suite."""
