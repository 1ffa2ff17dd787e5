"""Level ``fine``: the fitted head drawn to the dense surface, vertex by vertex, as far as that surface speaks."""
