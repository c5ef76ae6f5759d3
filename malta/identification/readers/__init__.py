"""Readers of logs as instruments and other programs write them: what a file holds, its columns, its raster."""
