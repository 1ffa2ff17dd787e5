"""Reconstructs many captures, one result folder each, and lists all heads in one table.

Captures are found below a folder or listed in a file. Processes and machines share the work through files alone.
Enters: captures on a disk. Leaves: the folder ``OUT`` that docs/batch.md describes."""
