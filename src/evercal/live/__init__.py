"""A robot and cameras while they run: their interfaces, recording with them, and its coverage."""
