"""Measures where a job's processor seconds go, and how much faster more cores would make it."""
