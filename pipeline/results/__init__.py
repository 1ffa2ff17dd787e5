"""Defines what a reconstruction consists of, and writes its result folder."""
