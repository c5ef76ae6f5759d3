"""The loop of a machine and its law, and everything linear that is asked of it.

loop, sampled_loops         machine x law x operating point x parameters, over one sample
linear_loops, loop_systems  any loop as matrices; systems of python-control
classical, channels         disk, delay, gain and phase margins
curves, locus               responses, poles, zeros; root loci
steps, recovery             answers to references and loads
"""
