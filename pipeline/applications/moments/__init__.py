"""Reconstructs several shots of one person together. A *moment* is one capture, a set of simultaneous pictures; a
*take* is several captures with different expressions. All captures of a take share one identity, the head's shape
without expression."""
