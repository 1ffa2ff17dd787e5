"""Many captures, one result folder each: found or listed, shared out among processes and machines by files alone, and
told in one table. What enters are captures on a disk; what leaves is ``OUT`` of docs/batch.md."""
