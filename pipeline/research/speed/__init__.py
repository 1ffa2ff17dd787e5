"""Measures where a job's processor seconds go, and what more cores would do."""
