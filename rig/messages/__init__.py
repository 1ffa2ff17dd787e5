"""Defines messages as data: a code, named parameters, and the English text that the catalogue makes from them.

The function ``compose`` makes a frozen ``Message`` from a code of the catalogue and its parameters. A message is sent
as ``{code, message, parameters}`` and translated by code and parameters, never by its words.
"""
