"""What the paper on the planar motor publishes, beside our figures; nothing that designs loads it."""
