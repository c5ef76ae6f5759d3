"""Campaigns: one scenario on thousands of machines.

plan -> block -> store -> result -> statistics, with run.py above them and dask.py for a cluster
"""
