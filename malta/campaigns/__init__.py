"""Campaigns: one scenario on thousands of machines, or on a hundred million.

sampling -> plan -> block -> store -> result -> statistics, with run.py above them and dask.py for a cluster
                                   -> sketch -> summary -> survey, status: of any size, without the figures of each run
limits -> rare, sensitivity, tolerance: studies on the box of a plan
"""
