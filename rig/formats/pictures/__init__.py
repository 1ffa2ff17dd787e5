"""Reads and writes pictures and masks, and interprets their names and numbers.

In: files from any source. Out: arrays of 8 bits and the subject's share in every pixel."""
