"""Runs compiled loops, divides them among threads, and caches arrays that depend on the head model alone.

This package contains nothing about heads or images; every package may use it."""
