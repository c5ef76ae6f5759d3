"""The proof of a margin as a file, and its check from the file's matrices alone."""
