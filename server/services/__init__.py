"""Implements the service's rules: captures, sessions, jobs, calibrations, rigs, keys, webhooks, retention."""
