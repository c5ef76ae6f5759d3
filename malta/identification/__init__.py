"""From the bench back to the design: logs, excitation, parameters with intervals, and what a stroke teaches."""
