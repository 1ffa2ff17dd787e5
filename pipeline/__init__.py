"""From a capture to a head: one module per section of the paper."""
