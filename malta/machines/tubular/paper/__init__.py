"""What the paper on MALTA publishes, beside our figures; nothing that designs loads it."""
