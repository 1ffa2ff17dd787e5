"""Reconstructs several shots of one person together. A *moment* is one synchronised set of pictures; a *take* is a set
of moments with different expressions. All moments of a take share one identity: the head's shape without expression."""
