"""Reads and writes pictures and masks, and says what their names and numbers mean.

Enters: files that anybody may have made. Leaves: arrays of 8 bits and the share of the subject in every pixel."""
