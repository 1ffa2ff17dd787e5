"""Reads and writes all persistent data: the database and the data folder."""
