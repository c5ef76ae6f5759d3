"""Campaigns: plans of many runs, blocks in a folder, threads or a cluster, statistics."""
