"""A maglev planar motor."""
