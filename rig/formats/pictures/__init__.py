"""Reads and writes pictures and masks, and interprets their file names and pixel values.

The output of readers is 8-bit arrays and, for masks, the subject's share in every pixel."""
