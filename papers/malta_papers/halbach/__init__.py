"""What the paper on the Halbach linear motor shows: its claims, and experiments and figures that replicate it."""
