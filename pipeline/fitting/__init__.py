"""Fitting a head to silhouettes (section 4): one solver a module, one ``Fit`` for both."""
