"""Holds the English templates, one module for each area of the program; each code is in one module."""
