"""The exclusion of zeros on the boundary of stability, and the nearest zero that there is."""
