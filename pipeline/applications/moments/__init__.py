"""One person and many shots. A *moment* is one synchronised set of pictures; a *take* is a set of moments of one person
in different expressions, without order. They share one identity: the shape of the head without its expression."""
