"""What the paper on the planar motor shows: its claims, and experiments and figures that replicate it."""
