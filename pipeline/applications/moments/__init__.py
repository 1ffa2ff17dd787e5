"""Reconstructs several shots of one person together. A *moment* is one capture, a synchronised set of pictures; a
*take* is several captures with different expressions. All moments of a take share one identity: the head's shape
without expression."""
