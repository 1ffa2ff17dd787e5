"""Implements the process that takes jobs from a queue, and takes over those of workers that died."""
