"""Reads and writes everything that outlives a process: the database and the data folder."""
