"""Defines messages as data: a code, named parameters, and the English text that the catalogue makes from them.

In: a code of the catalogue and its parameters. Out: a frozen ``Message``. It is sent as ``{code, message, parameters}``
and translated by code and parameters, never by its words.
"""
