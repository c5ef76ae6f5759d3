"""What the paper on MALTA shows: its claims, and experiments and figures that replicate it."""
