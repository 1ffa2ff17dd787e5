"""Measures what becomes of spoilt captures: moved and exchanged cameras, planted objects, photographs alone."""
