"""What the paper on the Halbach linear motor publishes, beside our figures; nothing that designs loads it."""
