"""Reconstructs many captures into one result folder each, and lists all heads in one table.

Captures are found below a folder or listed in a file. Processes and machines divide the work by files alone. In:
captures on a disk. Out: the folder ``OUT`` that docs/batch.md describes."""
