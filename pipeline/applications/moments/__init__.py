"""Solves several shots of one person together. A *moment* is one synchronised set of pictures; a *take* is a set of
moments of one person with different expressions. They share one identity: the head's shape without expression."""
