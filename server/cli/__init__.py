"""Implements the command line ``eigenhead``: one module for each group of commands."""
