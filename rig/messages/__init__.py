"""Messages as data: a code, parameters with names, and the English text that the catalogue makes of them.

Enters: a code of the catalogue and its parameters. Leaves: a frozen ``Message``, which travels as
``{code, message, parameters}`` and is translated by code and parameters, never by its words.
"""
