"""Defines messages as data: a code, named parameters, and the English text that the catalogue makes of them.

Enters: a code of the catalogue and its parameters. Leaves: a frozen ``Message``, which is sent as ``{code, message,
parameters}`` and is translated by code and parameters, never by its words.
"""
