"""Defines the content of a reconstruction, and writes its result folder."""
