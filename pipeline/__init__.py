"""Reconstructs a head from a capture. The method works on values in memory and writes no files."""
