"""Runs compiled loops, shares them among threads, and caches arrays that depend on the model alone.

It knows nothing of heads or images; every package may use it.
"""
