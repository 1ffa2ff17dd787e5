"""Reconstructs several captures of one person together. A *moment* is one capture; a *take* is several captures with
different expressions, which share one identity: the head's shape without expression."""
