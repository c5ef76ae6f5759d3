"""A linear motor with a Halbach array."""
